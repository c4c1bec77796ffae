"""Typed events of a run, and the dispatcher that keeps observers from harming it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from droidw.interfaces.observers import Observer
    from droidw.slam.frame import RunResult

__all__ = [
    "Dispatcher",
    "Event",
    "FrameTracked",
    "KeyframeAdded",
    "KeyframeRemoved",
    "Progress",
    "RunFailed",
    "RunFinished",
    "RunStarted",
    "RunWarning",
]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Event:
    """Base of all events."""


@dataclass(frozen=True)
class RunStarted(Event):
    """Everything is built; the first frame comes next. `length` is None if unknown."""

    source: str
    run_dir: Path
    length: int | None
    facts: dict[str, Any]


@dataclass(frozen=True)
class FrameTracked(Event):
    """A frame has been looked at by the motion filter (and perhaps became a keyframe)."""

    index: int
    time: float
    done: int
    keyframes: int


@dataclass(frozen=True)
class KeyframeAdded(Event):
    """Keyframe number `keyframe` (position in the store) was made from frame `index`.

    It is the last one, or comes in between others: later ones move up.
    """

    keyframe: int
    index: int


@dataclass(frozen=True)
class KeyframeRemoved(Event):
    """A keyframe added nothing and was dropped: the newest, or one shortly before it."""

    keyframe: int
    index: int


@dataclass(frozen=True)
class Progress(Event):
    """Progress of a stage after tracking: "global", "fill" or "export"."""

    stage: str
    done: int
    total: int


@dataclass(frozen=True)
class RunWarning(Event):
    """Something the user should know, as a sentence; also listed in the report."""

    text: str


@dataclass(frozen=True)
class RunFinished(Event):
    """All files of the exporters are written. `metrics` is None where truth is unknown."""

    result: RunResult
    run_dir: Path
    metrics: dict[str, Any] | None


@dataclass(frozen=True)
class RunFailed(Event):
    """The run ends with an error; what had been computed is written."""

    error: str


class Dispatcher:
    """Hands events to observers; one that raises is reported and silenced.

    Args:
        observers: (name, observer) pairs, called in this order.
    """

    def __init__(self, observers: Sequence[tuple[str, Observer]] = ()) -> None:
        self._observers = list(observers)
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        """Record a warning once, log it, and tell the observers."""
        if text in self.warnings:
            return
        self.warnings.append(text)
        _log.warning(text)
        self.emit(RunWarning(text))

    def emit(self, event: Event) -> None:
        """Tell every observer; an exception in one of them does not leave this call."""
        for entry in list(self._observers):
            name, observer = entry
            try:
                observer.on_event(event)
            except (Exception, SystemExit) as error:  # noqa: BLE001 - observers are strangers' code
                self._observers.remove(entry)
                _log.debug("observer %s raised", name, exc_info=True)
                self.warn(
                    f"observer '{name}' raised {type(error).__name__}: {error}; "
                    "it is not called again"
                )
