"""Which frames are worth a keyframe, judged ahead of the window as far as that can be known."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from droidw.interfaces.correspondence import Motion, SetsAside
from droidw.solve.weights import CLOSED

if TYPE_CHECKING:
    import numpy.typing as npt
    from torch import Tensor

    from droidw.config.schema import MotionFilterConfig
    from droidw.interfaces.correspondence import Correspondence
    from droidw.slam.frame import Frame

__all__ = ["Encoded", "MotionFilter", "Verdict", "spans"]

# Most of a picture is taken to stand still, whatever could move; and of pictures in which nothing
# does, up to a tenth is taken for what can. In between it counts little by little: no one cell
# decides.
_LEAST_HIDDEN, _PLAINLY_HIDDEN, _MOST_HIDDEN = 0.1, 0.3, 0.5


@dataclass(frozen=True)
class Encoded:
    """A frame and what correspondence made of it; of one that becomes a keyframe, more.

    Attributes:
        payload: of correspondence, of any frame. context: the same of a keyframe.
        features: [c,h,w]. prior: [h,w] inverse depth. Both only where they were made ahead.
        movable: [h,w] in [0,1], how much speaks for it that a cell can move; where it was asked.
        plain: the same frame with nothing hidden, where something is while it is tracked.
        ready: when all of this is done on a GPU, see `Ahead`; None where it is done.
    """

    frame: Frame
    payload: Any
    context: Any = None
    features: Tensor | None = None
    prior: Tensor | None = None
    movable: Tensor | None = None
    plain: Encoded | None = None
    ready: Any = None


@dataclass(frozen=True)
class Verdict:
    """What the filter says of one frame.

    Attributes:
        keep: make it a keyframe.
        forced: `force_every` frames have passed since the last keyframe; it is to stay.
        motion: measured against the reference; None for the first one.
    """

    keep: bool
    forced: bool
    motion: Motion | None


class MotionFilter:
    """Compares each frame with the last candidate (REFERENCE 5.1).

    What it says depends on the frames alone, so that it may run ahead of the window in a thread;
    but for keyframes forced by a count, which is from the last one that the window has kept. There
    it waits for `settled`, if what the window will say makes a difference.

    Args:
        correspondence: measures motion.
        options: thresholds.
        ahead: the window works in another thread, and can be waited for.
    """

    def __init__(
        self,
        correspondence: Correspondence,
        options: MotionFilterConfig,
        ahead: bool = False,
    ) -> None:
        self._correspondence = correspondence
        self._options = options
        self._reference: Encoded | None = None
        self._threshold = options.threshold
        # Frames judged, and how many were when the last keyframe was; candidates by the index of
        # their frame, of which the window may have yet to decide; and the newest of them, if so.
        self._judged = self._last = 0
        self._candidates: dict[int, int] = {}
        self._open: int | None = None
        self._closed = not ahead
        self._window = threading.Condition()
        self._lost = 0

    def judge(self, current: Encoded) -> Verdict:
        """Whether `current` becomes a keyframe; if so it is the reference from now on.

        The first is one that shows something: nothing could be matched with a blank one, and all
        poses would hang on it.
        """
        self._judged += 1
        if self._reference is None and current.frame.is_blank:
            return Verdict(keep=False, forced=False, motion=Motion(0.0, 0.0))
        if self._reference is None:
            self._accept(current, forced=True)
            return Verdict(keep=True, forced=False, motion=None)
        motion = self._correspondence.motion(self._reference.payload, current.payload)
        options = self._options
        forced = options.force_every > 0 and self._gap() >= options.force_every
        keep = motion.flow > self._threshold
        if motion.matched < options.min_matched and motion.matched >= options.lost_below:
            keep = True
        elif motion.matched < options.lost_below:
            # A blank or broken picture teaches nothing; a lasting change of view does.
            self._lost += 1
            keep = self._lost >= options.patience
        if motion.matched >= options.lost_below:
            self._lost = 0
        if keep or forced:
            self._accept(current, forced)
        return Verdict(keep=keep or forced, forced=forced, motion=motion)

    def ends(self, verdict: Verdict, newest: int) -> bool:
        """Whether the last frame becomes a keyframe because there is no other.

        Frames beyond all keyframes are seen from one side only, and several times as far off.

        Args:
            verdict: on that frame. newest: index of the frame of the newest keyframe.
        """
        options, motion = self._options, verdict.motion
        if self._reference is None or motion is None or options.last_above >= 1:
            return False
        if motion.matched < options.lost_below:
            return False
        # What it was compared with may have been dropped: that had moved, too.
        dropped = self._reference.frame.index != newest
        return dropped or motion.flow > options.last_above * self._threshold

    def set_aside(
        self, current: Encoded, cells: Tensor | None, masked: Tensor | None = None
    ) -> None:
        """What may move by itself in the frame just kept is not motion of a picture.

        And the next keyframe comes nearer, as what is hidden, by that or by a mask, tells nothing.

        Args:
            cells: bool [h,w], what may move; only of a correspondence that `SetsAside`. None:
                nothing. masked: bool [h,w]; None: nothing.
        """
        gone = [hidden.cpu() for hidden in (cells, masked) if hidden is not None]
        if gone:
            near = float(nearness(torch.stack(gone).any(dim=0), self._options))
            self._threshold = self._options.threshold * near
        operator = self._correspondence
        if cells is not None and isinstance(operator, SetsAside):
            payload = operator.aside(current.payload, gone[0])
            self._reference = replace(current, payload=payload)

    def settled(self, index: int, kept: bool) -> None:
        """Whether candidate `index` has become a keyframe for good: frames are counted from it."""
        with self._window:
            judged = self._candidates.pop(index, 0)
            if kept:
                self._last = max(self._last, judged)
            if self._open == index:
                self._open = None
            self._window.notify_all()

    def close(self) -> None:
        """Nothing will be settled any more: whoever waits for it goes on."""
        with self._window:
            self._closed = True
            self._window.notify_all()

    def _gap(self) -> int:
        """Frames since the last keyframe that the window has kept, where that matters."""
        with self._window:
            while (
                self._open is not None
                and not self._closed
                and self._judged - self._last >= self._options.force_every
            ):
                self._window.wait()
            return self._judged - self._last

    def _accept(self, current: Encoded, forced: bool) -> None:
        self._reference = current
        self._threshold = self._options.threshold
        self._lost = 0
        with self._window:
            if forced:  # the window may not drop it
                self._last, self._open = self._judged, None
            else:
                self._open = current.frame.index
                self._candidates[self._open] = self._judged


def nearness(cells: Tensor, options: MotionFilterConfig) -> npt.NDArray[np.float64]:
    """In [0,1], by what keyframes come nearer where cells, bool [...,h,w], tell nothing, [...]."""
    share = cells.float().mean(dim=(-2, -1)).double().cpu().numpy()
    counts = np.clip((share - _LEAST_HIDDEN) / (_PLAINLY_HIDDEN - _LEAST_HIDDEN), 0.0, 1.0)
    hidden = counts * np.minimum(share, _MOST_HIDDEN)
    near: npt.NDArray[np.float64] = 1.0 - options.movable_nearer * hidden
    return near


def spans(
    movable: Tensor, unmasked: Tensor, options: MotionFilterConfig
) -> npt.NDArray[np.float64]:
    """What part of a usual step leads to each keyframe, [N].

    Args:
        movable: [N,h,w] in [0,1], how much speaks for it that a cell can move.
        unmasked: [N,h,w] in [0,1], what masks leave.
    """
    if options.movable_nearer == 0:
        return np.ones(len(movable))
    gone = unmasked < CLOSED
    if options.movable_above > 0:
        gone = gone | (movable > options.movable_above)
    return nearness(gone, options)
