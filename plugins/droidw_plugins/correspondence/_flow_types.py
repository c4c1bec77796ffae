"""What correspondence `flow` keeps: of a frame, of an edge, and of the motion so far."""

from __future__ import annotations

import threading
import zlib
from collections import OrderedDict
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

__all__ = [
    "Array",
    "Edge",
    "FlowFrame",
    "Found",
    "Kept",
    "Track",
    "held",
    "set_out_from",
    "taken_out_alike",
]

Array = npt.NDArray[np.float32]
Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")

# Median distance of two starts, in cells, that lead to the same result: a search goes on from the
# coarsest level, where a pixel is little, and of what is off in a flow that it looks through a
# hundredth is left.
_SAME_START = 0.15
# Power of the picture along the strongest edge of a cell from which on a match cannot slip there,
# (grey levels per pixel)^2, and of any place, as a share of that across it: a point on a line may
# lie anywhere along it and is usually off by half a pixel, one that is held by a tenth.
_SOME_POWER, _HELD = 1.0, 0.1
# Frames that may be missing before the motion so far is forgotten.
_LONGEST_GAP = 3


@dataclass(frozen=True)
class FlowFrame:
    """Payload of one frame: its grey image, and what surrounds each cell of the grid.

    Attributes:
        grey: [H,W] uint8, as softened as searches want it.
        texture: [h,w,2] root mean square image derivative that fixes a match along x and along y,
            each with the other free, grey levels per pixel.
        power: [h,w,2] mean square derivative along `normal` and at right angles to it, the
            eigenvalues of the structure tensor, larger first, (grey levels per pixel)^2.
        normal: [h,w,2] unit vector across the strongest edge, x and y.
        centres: [h,w,2] of the cells, pixels.
        covered: [H,W] what the frame's mask covers: `grey` is a smooth bridge there; None: nothing.
        key: tells frames apart, and pictures of one frame with different masks.
        bridged: [h,w] cells over which `grey` is a smooth bridge, see `_flow_mask`; None: nowhere.
        unsoftened: [H,W] uint8, `grey` as it was; None: it has not been softened.
        aside: [h,w] cells that may move by themselves: they do not tell how far the picture moved;
            None: none.
    """

    index: int
    grey: npt.NDArray[np.uint8]
    texture: Array
    power: Array
    normal: Array
    centres: Array
    stride: int
    covered: npt.NDArray[np.bool_] | None = None
    bridged: npt.NDArray[np.bool_] | None = None
    unsoftened: npt.NDArray[np.uint8] | None = None
    aside: npt.NDArray[np.bool_] | None = None
    key: tuple[int, int] = field(init=False)

    def __post_init__(self) -> None:
        cover = 0 if self.covered is None else zlib.crc32(np.packbits(self.covered).tobytes())
        object.__setattr__(self, "key", (self.index, cover))

    @cached_property
    def held(self) -> float:
        """Share of the cells that are not bridged and have structure in two directions."""
        cells = held(self.power) & (self.power[..., 1] > _SOME_POWER)
        return float((cells if self.bridged is None else cells & ~self.bridged).mean())

    @property
    def sharp(self) -> npt.NDArray[np.uint8]:
        """The picture [H,W] before it was softened."""
        return self.grey if self.unsoftened is None else self.unsoftened


@dataclass(frozen=True)
class Found:
    """What a search there and back comes to at the cells of one frame.

    Attributes:
        moved: [h,w,2] displacement, pixels.
        apart: [h,w,2] where the way there and back ends, seen from its start, pixels.
        share: [h,w] in [0,1], what `framed` and, if asked for, `likeness` leave of confidence.
        flow: [H,W,2] pixels, where lines that turn are to be followed; else None.
        started: [h,w,2] targets from which the search started; None: free.
    """

    moved: Array
    apart: Array
    share: Array
    flow: Array | None
    started: Array | None


@dataclass
class Edge:
    """What is known of one directed edge: target [h,w,2] in cells, and confidence [h,w,3].

    Attributes:
        started: [h,w,2] targets from which the search started; None: free.
        bridged: [h,w] cells that were taken out of the picture it starts in; None: none.
        searches: how often it was searched.
        blind: searched before geometry could be believed.
    """

    target: Array
    confidence: Array
    started: Array | None
    bridged: npt.NDArray[np.bool_] | None = None
    searches: int = 1
    blind: bool = False


@dataclass(frozen=True)
class Track:
    """The motion filter's last flow, and how it was growing.

    Attributes:
        reference, current: frames between which `flow` holds.
        flow: [H,W,2] pixels, reference to current.
        velocity: [H,W,2] pixels per frame of the source.
    """

    reference: int
    current: int
    flow: Array
    velocity: Array

    @classmethod
    def after(
        cls, before: Track | None, reference: FlowFrame, current: FlowFrame, flow: Array
    ) -> Track:
        """The track one measurement later."""
        if before is not None and before.reference == reference.index:
            velocity = (flow - before.flow) / np.float32(max(current.index - before.current, 1))
        else:
            velocity = flow / np.float32(max(current.index - reference.index, 1))
        return cls(reference.index, current.index, flow, velocity)

    def ahead(self, reference: FlowFrame, current: FlowFrame, step: int) -> Array | None:
        """The flow from `reference` to a later frame if all goes on; None if that is unknown.

        The velocity belongs to pixels of an older frame: good enough for a start.

        Args:
            step: by how much the index grows from one frame to the next, if none is missing.
        """
        gap = current.index - self.current
        if not 0 < gap <= _LONGEST_GAP * step:
            return None
        going_on: Array = self.velocity * np.float32(gap)
        if reference.index == self.reference:
            going_on += self.flow
            return going_on
        return going_on if reference.index == self.current else None


class Kept(Generic[Key, Value]):
    """The last `most` values that were put, by key; may be asked from any thread."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._values: OrderedDict[Key, Value] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Key) -> Value | None:
        """What was put under this key, or None."""
        with self._lock:
            return self._values.get(key)

    def put(self, key: Key, value: Value) -> None:
        """Keep a value, and give up the oldest where that is one too many."""
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            self._give_up()

    def _give_up(self) -> None:
        while len(self._values) > self._most:
            self._values.popitem(last=False)


class KeptInRounds(Kept[Key, Value]):
    """The same where values depend on more than their keys: which are given up shows in results.

    Threads of one round end in any order. So values are given up between rounds alone, and those of
    one round in the order of their keys. A round of more than there is room for keeps the first of
    them, so that the next one like it finds these.
    """

    def __init__(self, most: int) -> None:
        super().__init__(most)
        self._fresh: set[Key] = set()
        self._room: set[Key] | None = None

    def begin(self, keys: Iterable[Key]) -> None:
        """Begin a round in which values of these keys are put."""
        ordered = sorted(keys, key=repr)
        self._room = set(ordered[: self._most]) if len(ordered) > self._most else None

    def put(self, key: Key, value: Value) -> None:
        """Keep a value till the round is over, if there is room for it."""
        with self._lock:
            if self._room is None or key in self._room:
                self._values[key] = value
                self._fresh.add(key)

    def settle(self) -> None:
        """End a round: nothing is put meanwhile."""
        with self._lock:
            for key in sorted(self._fresh, key=repr):
                self._values.move_to_end(key)
            self._fresh.clear()
            self._room = None
            self._give_up()


def held(power: Array) -> npt.NDArray[np.bool_]:
    """Which places have structure in two directions, [...], by both powers [...,2] of each."""
    enough: npt.NDArray[np.bool_] = power[..., 1] > _HELD * power[..., 0]
    return enough


def set_out_from(
    known: tuple[Edge | Found, Edge | Found],
    starts: tuple[Array | None, Array | None],
    within: float = _SAME_START,
) -> bool:
    """Whether searches both ways began at about these starts: free as they, or `within` cells."""
    return all(_close(one.started, s, within) for one, s in zip(known, starts, strict=True))


def taken_out_alike(
    known: tuple[Edge, Edge], frames: tuple[FlowFrame, FlowFrame], share: float
) -> bool:
    """Whether cells taken out of both pictures were these, but for at most a share of each."""
    for edge, frame in zip(known, frames, strict=True):
        one, other = edge.bridged, frame.bridged
        if one is other:
            continue
        cells = frame.power.shape[:2]
        blank = np.zeros(cells, np.bool_)
        changed = (blank if one is None else one) != (blank if other is None else other)
        if changed.mean() > share:
            return False
    return True


def _close(one: Array | None, other: Array | None, within: float) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.median(np.abs(one - other)) < within)
