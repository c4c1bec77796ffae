"""The progress line on a terminal, elsewhere and when told to be quiet."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest

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
from droidw.interfaces.observers import Observer
from droidw.plugin.component import BuildContext
from droidw_plugins.observers._progress_line import ProgressLine, memory_mib
from droidw_plugins.observers.progress import COMPONENT, ProgressOptions


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


class Clock:
    """Seconds that pass when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Bench:
    """An observer on a fake stream, 0.05 s between two events."""

    def __init__(self, stream: io.StringIO, **options: object) -> None:
        self.stream, self.clock = stream, Clock()
        self.line = ProgressLine(
            stream=stream,
            clock=self.clock,
            memory=lambda: 411.6,
            **options,  # type: ignore[arg-type]
        )

    def tell(self, event: Event, after: float = 0.05) -> None:
        self.clock.now += after
        self.line.on_event(event)

    def run(self, result: object, frames: int = 200, length: int | None = 200) -> list[str]:
        """A whole run; the lines that are left on the stream."""
        self.tell(RunStarted("clip.mp4", Path("run"), length, {}))
        for i in range(frames):
            if i % 10 == 0:
                self.tell(KeyframeAdded(i // 10, i), 0.0)
            self.tell(FrameTracked(i, i / 30, i + 1, i // 10 + 1))
        for i in range(3):
            self.tell(Progress("global", i + 1, 3), 2.0)
        for i in range(frames):
            self.tell(Progress("fill", i + 1, frames), 0.01)
        self.tell(RunFinished(result, Path("run"), None))  # type: ignore[arg-type]
        return on_screen(self.stream.getvalue())


def on_screen(text: str) -> list[str]:
    """What a terminal shows after these characters."""
    lines = []
    for line in text.split("\n"):
        shown = line.rpartition("\r")[2]
        lines.append(shown.removesuffix("\x1b[K"))
    assert lines[-1] == "", "the last line is not finished"
    return lines[:-1]


def test_terminal_keeps_one_line_a_stage() -> None:
    bench = Bench(Terminal())
    lines = bench.run(None)
    assert len(lines) == 3
    assert lines[0].startswith("tracking  200 frames  20 keyframes  10.")
    assert "20.0 frames/s" in lines[0] and lines[0].endswith("412 MiB")
    assert lines[1].startswith("global bundle adjustment  6.0 s")
    assert lines[2].startswith("poses of all frames  200 frames")


def test_footage_that_is_tracked_once_more_has_a_line_of_its_own() -> None:
    bench = Bench(io.StringIO())
    bench.tell(RunStarted("clip.mp4", Path("run"), 20, {}))
    for speed in (0.05, 0.1):
        for i in range(20):
            bench.tell(FrameTracked(i, i / 30, i + 1, 3), speed)
        bench.tell(Progress("global", 1, 1), 1.0)
        bench.tell(Progress("fill", 20, 20), 1.0)
    bench.tell(RunFinished(None, Path("run"), None))  # type: ignore[arg-type]
    lines = on_screen(bench.stream.getvalue())
    tracking = [line for line in lines if line.startswith("tracking")]
    assert [line.split("  ")[1] for line in tracking] == ["20 frames", "20 frames"]
    assert "20.0 frames/s" in tracking[0]
    assert "10.0 frames/s" in tracking[1]
    assert sum(line.startswith("global") for line in lines) == 2


def test_live_line_tells_speed_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    bench = Bench(Terminal())
    bench.tell(RunStarted("clip.mp4", Path("run"), 2000, {}))
    for i in range(200):
        bench.tell(FrameTracked(i, i / 30, i + 1, 7))
    last = bench.stream.getvalue().rpartition("\r")[2].removesuffix("\x1b[K")
    assert "7 keyframes" in last and "20.0 frames/s" in last and "1:30 left" in last
    assert bench.stream.getvalue().count("\r") <= 101, "redrawn at most ten times a second"
    assert "\n" not in bench.stream.getvalue()


def test_live_line_never_wraps() -> None:
    bench = Bench(Terminal())
    bench.run(None)
    for part in bench.stream.getvalue().replace("\n", "\r").split("\r"):
        assert len(part.removesuffix("\x1b[K")) < 80


def test_elsewhere_a_plain_line_now_and_then() -> None:
    bench = Bench(io.StringIO(), interval=2.99)
    lines = bench.run(None)
    text = bench.stream.getvalue()
    assert "\r" not in text and "\x1b" not in text
    tracking = [line for line in lines if line.startswith("tracking")]
    assert len(tracking) == 4  # after 3, 6, 9 s and the summary
    assert tracking[0].startswith("tracking  60/200  6 keyframes")
    assert sum(line.startswith("poses of all frames") for line in lines) == 1


def test_unknown_length_has_no_time_left() -> None:
    bench = Bench(io.StringIO(), interval=0.99)
    lines = bench.run(None, length=None)
    assert not any("left" in line for line in lines if line.startswith("tracking"))
    assert lines[0].startswith("tracking  20  2 keyframes")


def test_dropped_keyframes_are_not_counted() -> None:
    bench = Bench(io.StringIO(), interval=0.01)
    bench.tell(RunStarted("clip.mp4", Path("run"), 9, {}))
    bench.tell(FrameTracked(0, 0.0, 1, 2))
    bench.tell(KeyframeAdded(2, 1))
    bench.tell(KeyframeRemoved(2, 1))
    bench.tell(RunFailed("no motion"))
    assert (
        bench.stream.getvalue()
        .splitlines()[-1]
        .startswith("tracking stopped  1 frames  2 keyframes")
    )


def test_a_failure_before_the_first_frame_ends_clean() -> None:
    bench = Bench(io.StringIO())
    bench.tell(RunFailed("nothing to read"))
    assert bench.stream.getvalue() == ""


def test_a_warning_starts_a_fresh_line() -> None:
    bench = Bench(Terminal())
    bench.tell(RunStarted("clip.mp4", Path("run"), 9, {}))
    bench.tell(FrameTracked(0, 0.0, 1, 1))
    drawn = bench.stream.getvalue().count("\r")
    bench.tell(RunWarning("the camera may be static"), 0.0)
    bench.tell(FrameTracked(1, 0.0, 2, 1), 0.0)
    assert bench.stream.getvalue().count("\r") == drawn + 1


def test_quiet_says_nothing() -> None:
    bench = Bench(Terminal(), enabled=False)
    bench.line.on_event(RunStarted("clip.mp4", Path("run"), 9, {}))
    bench.line.on_event(FrameTracked(0, 0.0, 1, 1))
    bench.line.on_event(RunFailed("x"))
    assert bench.stream.getvalue() == ""


def test_a_closed_stream_does_not_disturb() -> None:
    stream = io.StringIO()
    bench = Bench(stream, interval=0.01)
    bench.tell(RunStarted("clip.mp4", Path("run"), 9, {}))
    stream.close()
    bench.tell(FrameTracked(0, 0.0, 1, 1))
    bench.tell(RunFailed("x"))


def test_memory_is_known_here() -> None:
    memory = memory_mib()
    assert memory is not None and 1 < memory < 1e6


def test_component_is_light_and_builds() -> None:
    code = (
        "import sys; import droidw_plugins.observers.progress, droidw_plugins.observers.report;"
        "heavy = {'torch', 'cv2', 'kornia'} & set(sys.modules);"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    import torch

    observer = COMPONENT.factory(ProgressOptions(), BuildContext(torch.device("cpu")))
    assert isinstance(observer, Observer)
