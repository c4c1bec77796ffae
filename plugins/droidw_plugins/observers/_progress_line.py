"""The observer behind `progress`."""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import TextIO

from droidw.events import (
    Event,
    FrameTracked,
    KeyframeAdded,
    KeyframeRemoved,
    Progress,
    RunFailed,
    RunFinished,
    RunStarted,
    RunWarning,
)

__all__ = ["ProgressLine", "memory_mib"]

_LABELS = {
    "global": "global bundle adjustment",
    "backwards": "second look",
    "fill": "poses of all frames",
    "export": "export",
}
_REFRESH = 0.1
_WINDOW = 5.0
_EVENTS = 30
_BAR = 20


class ProgressLine:
    """Shows how far a run is; each stage leaves one line behind.

    On a terminal the line is redrawn in place, at most ten times a second. Elsewhere a line is
    printed every `interval` seconds and one at the end of each stage.

    Args:
        enabled: False to stay silent.
        interval: seconds between lines where the stream is no terminal.
        stream: where to write; None for stderr, looked up at each write.
        clock: seconds that only rise.
        memory: resident memory in MiB, or None where it cannot be known.
    """

    def __init__(
        self,
        enabled: bool = True,
        interval: float = 5.0,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        memory: Callable[[], float | None] | None = None,
    ) -> None:
        self._enabled = enabled
        self._interval = interval
        self._given_stream = stream
        self._clock = clock
        self._memory = memory or memory_mib
        self._stage = ""
        self._done = 0
        self._total: int | None = None
        self._length: int | None = None
        self._keyframes = 0
        self._started = 0.0
        self._heard = 0.0
        self._drawn = float("-inf")
        self._history: deque[tuple[float, int]] = deque()

    def on_event(self, event: Event) -> None:
        """Take note of an event, and draw if it is time."""
        if not self._enabled:
            return
        if isinstance(event, RunStarted):
            self._length = event.length
            self._begin("tracking", event.length)
        elif isinstance(event, FrameTracked):
            if self._stage != "tracking":
                # Nothing was said of a start; or the footage is tracked once more.
                self._end()
                self._begin("tracking", self._length, self._heard or None)
            self._keyframes = event.keyframes
            self._advance(event.done, self._total)
        elif isinstance(event, KeyframeAdded):
            self._keyframes = event.keyframe + 1
        elif isinstance(event, KeyframeRemoved):
            self._keyframes = event.keyframe
        elif isinstance(event, Progress):
            if self._stage != event.stage:
                self._end()
                # Its first news come when part of it is done: it began when the last stage ended.
                self._begin(event.stage, event.total, self._heard)
            self._advance(event.done, event.total)
        elif isinstance(event, RunWarning):
            # The log has just written the warning behind our line: start on a fresh one.
            self._drawn = float("-inf")
        elif isinstance(event, RunFinished):
            self._end()
        elif isinstance(event, RunFailed):
            self._end(failed=True)

    @property
    def _stream(self) -> TextIO:
        return self._given_stream if self._given_stream is not None else sys.stderr

    def _begin(self, stage: str, total: int | None, began: float | None = None) -> None:
        now = self._clock()
        self._stage, self._total, self._done = stage, total, 0
        self._started = self._heard = now if began is None else began
        self._history.clear()
        self._history.append((self._started, 0))
        # The live line appears at once; the first plain line after one interval.
        self._drawn = float("-inf") if self._live() else now

    def _advance(self, done: int, total: int | None) -> None:
        now = self._clock()
        self._done, self._total = done, total
        self._heard = now
        self._history.append((now, done))
        # At least some events: a keyframe takes long, and one alone would tell a wrong speed.
        while len(self._history) > _EVENTS and now - self._history[0][0] > _WINDOW:
            self._history.popleft()
        if now - self._drawn >= (_REFRESH if self._live() else self._interval):
            self._drawn = now
            self._draw(self._line(now))

    def _end(self, failed: bool = False) -> None:
        if not self._stage:
            return
        self._draw(self._summary(failed), last=True)
        self._stage = ""

    def _line(self, now: float) -> str:
        parts = [f"{_LABELS.get(self._stage, self._stage)}"]
        unknown = not self._total
        parts.append(f"{self._done}" if unknown else f"{self._done}/{self._total}")
        if not unknown and self._live() and self._columns() >= 100:
            filled = min(_BAR, _BAR * self._done // max(self._total or 1, 1))
            parts.insert(1, "[" + "#" * filled + "." * (_BAR - filled) + "]")
        if self._stage == "tracking":
            parts.append(f"{self._keyframes} keyframe" + ("" if self._keyframes == 1 else "s"))
        since, count = self._history[0]
        speed = (self._done - count) / (now - since) if now > since else 0.0
        if self._stage in ("tracking", "fill") and speed > 0:
            parts.append(f"{speed:.1f} frames/s")
        if self._total and self._total > self._done > 0:
            pace = (now - self._started) / self._done
            parts.append(f"{_clock_text((self._total - self._done) * pace)} left")
        memory = self._memory()
        if memory is not None:
            parts.append(f"{memory:.0f} MiB")
        return "  ".join(parts)

    def _summary(self, failed: bool) -> str:
        took = self._heard - self._started
        label = _LABELS.get(self._stage, self._stage)
        parts = [label + (" stopped" if failed else "")]
        if self._stage in ("tracking", "fill"):
            parts.append(f"{self._done} frames")
        if self._stage == "tracking":
            parts.append(f"{self._keyframes} keyframe" + ("" if self._keyframes == 1 else "s"))
        parts.append(f"{took:.1f} s" if took < 60 else _clock_text(took))
        if self._stage in ("tracking", "fill") and took > 0 and self._done:
            parts.append(f"{self._done / took:.1f} frames/s")
        memory = self._memory()
        if memory is not None:
            parts.append(f"{memory:.0f} MiB")
        return "  ".join(parts)

    def _draw(self, text: str, last: bool = False) -> None:
        stream = self._stream
        try:
            if self._live():
                # One column stays free: a full line makes some terminals wrap.
                text = text[: max(self._columns() - 1, 1)]
                stream.write("\r" + text + "\x1b[K" + ("\n" if last else ""))
            else:
                stream.write(text + "\n")
            stream.flush()
        except (OSError, ValueError):
            # A closed pipe is no reason to bother the run.
            self._enabled = False

    def _live(self) -> bool:
        try:
            terminal = self._stream.isatty()
        except ValueError:
            return False
        return terminal and os.environ.get("TERM") != "dumb"

    def _columns(self) -> int:
        try:
            return os.get_terminal_size(self._stream.fileno()).columns or 80
        except (OSError, ValueError):
            return 80


def memory_mib() -> float | None:
    """Resident memory of this process in MiB, or None where the system does not tell."""
    try:
        with open("/proc/self/statm", encoding="ascii") as statm:
            pages = int(statm.read().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    except (OSError, ValueError, IndexError):
        pass
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS counts bytes, the others KiB; without /proc the peak stands for the present.
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def _clock_text(seconds: float) -> str:
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
    return f"{whole // 60}:{whole % 60:02d}"
