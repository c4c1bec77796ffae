"""`report`: one self-contained HTML page about a finished run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.observers import Observer

__all__ = ["COMPONENT", "ReportOptions"]


@dataclass(frozen=True)
class ReportOptions:
    """Options of `report`."""

    keyframes: int = field(
        default=24, metadata={"help": "keyframes shown, evenly chosen (0: none)", "ge": 0}
    )
    cloud_points: int = field(
        default=400_000, metadata={"help": "points drawn in the views of the cloud", "ge": 0}
    )


def _build(options: ReportOptions, context: BuildContext) -> Observer:
    from droidw_plugins.observers._report_page import Report

    return Report(keyframes=options.keyframes, cloud_points=options.cloud_points)


COMPONENT: Component[Observer] = Component(
    name="report",
    summary="report.html: trajectory, keyframes, cloud, timings and config on one page",
    factory=_build,
    options=ReportOptions,
    capabilities=frozenset({"cpu", "cuda"}),
)
