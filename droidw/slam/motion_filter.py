"""Which frames are worth a keyframe, and how far ahead of that question one can work."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from droidw.interfaces.correspondence import Motion

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.config.schema import MotionFilterConfig
    from droidw.interfaces.correspondence import Correspondence
    from droidw.slam.frame import Frame

T = TypeVar("T")

__all__ = ["Encoded", "MotionFilter", "Verdict", "look_ahead"]


@dataclass(frozen=True)
class Encoded:
    """A frame and what correspondence made of it; of one that becomes a keyframe, more.

    Attributes:
        payload: of correspondence, of any frame. context: the same of a keyframe.
        features: [c,h,w]. prior: [h,w] inverse depth. Both only where they were made ahead.
        ready: when all of this is done on a GPU, see `Ahead`; None where it is done.
    """

    frame: Frame
    payload: Any
    context: Any = None
    features: Tensor | None = None
    prior: Tensor | None = None
    ready: Any = None


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

    What it says depends on the frames alone, so that it may run ahead of the window in a thread.

    Args:
        correspondence: measures motion.
        options: thresholds.
    """

    def __init__(
        self,
        correspondence: Correspondence,
        options: MotionFilterConfig,
    ) -> None:
        self._correspondence = correspondence
        self._options = options
        self._reference: Encoded | None = None
        self._last_index: int | None = None
        self._lost = 0

    def judge(self, current: Encoded) -> Verdict:
        """Whether `current` becomes a keyframe; if so it is the reference from now on."""
        if self._reference is None:
            self._accept(current)
            return Verdict(keep=True, forced=False, motion=None)
        motion = self._correspondence.motion(self._reference.payload, current.payload)
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

    def _accept(self, current: Encoded) -> None:
        self._reference = current
        self._lost = 0


def look_ahead(items: Iterable[T], depth: int, pool: ThreadPoolExecutor | None) -> Iterator[T]:
    """Yield items in order, while a thread makes up to `depth` of those to come.

    Args:
        items: made one after the other, in whichever thread.
        pool: of one thread, or None to make each item when it is asked for.
    """
    if pool is None:
        yield from items
        return
    source = iter(items)
    waiting: deque[Future[T | None]] = deque()
    try:
        while True:
            while len(waiting) <= depth:
                waiting.append(pool.submit(next, source, None))
            item = waiting.popleft().result()
            if item is None:
                return
            yield item
    finally:
        # The source may not be closed while the thread is inside it.
        for future in waiting:
            if not future.cancel():
                wait([future])
