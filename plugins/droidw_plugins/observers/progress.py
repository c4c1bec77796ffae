"""`progress`: one live line on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.observers import Observer

__all__ = ["COMPONENT", "ProgressOptions"]


@dataclass(frozen=True)
class ProgressOptions:
    """Options of `progress`."""

    enabled: bool = field(default=True, metadata={"help": "false: say nothing (as with -q)"})
    interval: float = field(
        default=5.0,
        metadata={"help": "seconds between two lines when stderr is no terminal", "gt": 0},
    )


def _build(options: ProgressOptions, context: BuildContext) -> Observer:
    from droidw_plugins.observers._progress_line import ProgressLine

    return ProgressLine(enabled=options.enabled, interval=options.interval)


COMPONENT: Component[Observer] = Component(
    name="progress",
    summary="frame, keyframes, frames/s, time left and memory, on stderr",
    factory=_build,
    options=ProgressOptions,
    capabilities=frozenset({"cpu", "cuda"}),
)
