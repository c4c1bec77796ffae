"""Which frames are worth a keyframe, and how far ahead of that question one can work."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from droidw.interfaces.correspondence import Motion

if TYPE_CHECKING:
    from droidw.config.schema import MotionFilterConfig
    from droidw.interfaces.correspondence import Correspondence
    from droidw.slam.frame import Frame

__all__ = ["Encoded", "MotionFilter", "Verdict", "look_ahead"]


@dataclass(frozen=True)
class Encoded:
    """A frame and what correspondence made of it."""

    frame: Frame
    payload: Any


@dataclass(frozen=True)
class Verdict:
    """What the filter says of one frame.

    Attributes:
        keep: make it a keyframe.
        forced: `force_every` frames have passed since the last keyframe; it is to stay.
        motion: measured against the reference; None for the first frame.
    """

    keep: bool
    forced: bool
    motion: Motion | None


class MotionFilter:
    """Compares each frame with the last candidate (REFERENCE 5.1).

    Where correspondence may be called from threads, the motion of the frames ahead is measured
    while the window is being optimised, on the guess that the reference stays the same.

    Args:
        correspondence: measures motion.
        options: thresholds.
        pool: threads to work ahead with, or None.
    """

    def __init__(
        self,
        correspondence: Correspondence,
        options: MotionFilterConfig,
        pool: ThreadPoolExecutor | None = None,
    ) -> None:
        self._correspondence = correspondence
        self._options = options
        self._pool = pool
        self._reference: Encoded | None = None
        self._last_index: int | None = None
        self._lost = 0
        self._ahead: dict[tuple[int, int], Future[Motion]] = {}

    def judge(self, current: Encoded) -> Verdict:
        """Whether `current` becomes a keyframe; if so it is the reference from now on."""
        if self._reference is None:
            self._accept(current)
            return Verdict(keep=True, forced=False, motion=None)
        motion = self._measure(self._reference, current)
        options = self._options
        last = self._reference.frame.index if self._last_index is None else self._last_index
        gap = current.frame.index - last
        forced = options.force_every > 0 and gap >= options.force_every
        keep = motion.flow > options.threshold
        if motion.matched < options.min_matched and motion.matched >= options.lost_below:
            keep = True
        elif motion.matched < options.lost_below:
            # A blank or broken picture teaches nothing; a lasting change of view does.
            self._lost += 1
            keep = self._lost >= options.patience
        if motion.matched >= options.lost_below:
            self._lost = 0
        if keep or forced:
            self._accept(current)
        return Verdict(keep=keep or forced, forced=forced, motion=motion)

    def kept(self, index: int) -> None:
        """Frame `index` has become a keyframe for good: frames are counted from it."""
        self._last_index = index

    def expect(self, ahead: Iterable[Encoded]) -> None:
        """Start measuring these frames against the reference, if there are threads for it."""
        if self._pool is None or self._reference is None:
            return
        reference = self._reference
        for encoded in ahead:
            key = (reference.frame.index, encoded.frame.index)
            if key not in self._ahead:
                self._ahead[key] = self._pool.submit(
                    self._correspondence.motion, reference.payload, encoded.payload
                )

    def _accept(self, current: Encoded) -> None:
        self._reference = current
        self._lost = 0
        for future in self._ahead.values():
            future.cancel()
        self._ahead.clear()

    def _measure(self, reference: Encoded, current: Encoded) -> Motion:
        future = self._ahead.pop((reference.frame.index, current.frame.index), None)
        if future is not None and not future.cancelled():
            return future.result()
        return self._correspondence.motion(reference.payload, current.payload)


def look_ahead(
    items: Iterable[Encoded], depth: int, expect: Callable[[Iterable[Encoded]], None]
) -> Iterator[Encoded]:
    """Yield items in order while up to `depth` of those to come are announced to `expect`."""
    waiting: deque[Encoded] = deque()
    source = iter(items)
    exhausted = False
    while True:
        while not exhausted and len(waiting) <= depth:
            try:
                waiting.append(next(source))
            except StopIteration:
                exhausted = True
        if not waiting:
            return
        current = waiting.popleft()
        yield current
        expect(waiting)
