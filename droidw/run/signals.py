"""Ctrl-C and SIGTERM stop tracking at the next frame, and lose nothing."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterable, Iterator
from types import FrameType, TracebackType
from typing import Any, TypeVar

T = TypeVar("T")

_log = logging.getLogger(__name__)

__all__ = ["Stop"]


class Stop:
    """Within a `with` block the first signal only sets `signum`; the second acts as ever.

    Outside the main thread signals cannot be caught, and nothing changes.
    """

    def __init__(self) -> None:
        self.signum = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stop:
        if threading.current_thread() is threading.main_thread():
            for signum in (signal.SIGINT, signal.SIGTERM):
                self._before[signum] = signal.signal(signum, self._heard)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._restore()

    def until(self, items: Iterable[T]) -> Iterator[T]:
        """The items that come before a signal does."""
        for item in items:
            if self.signum:
                _log.warning("stopping: what was tracked is written; once more: stop at once")
                return
            yield item

    def _heard(self, signum: int, frame: FrameType | None) -> None:
        self.signum = signum
        self._restore()

    def _restore(self) -> None:
        for signum, handler in self._before.items():
            signal.signal(signum, handler)
        self._before.clear()
