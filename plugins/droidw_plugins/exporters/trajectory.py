"""Exporter `trajectory`: the camera's path as TUM files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.exporters import Exporter
    from droidw.slam.frame import RunResult

__all__ = ["COMPONENT", "TrajectoryExporter", "TrajectoryOptions"]


@dataclass(frozen=True)
class TrajectoryOptions:
    """Options of the exporter `trajectory`."""

    header: bool = field(
        default=True, metadata={"help": "begin each file with a comment that names the columns"}
    )


class TrajectoryExporter:
    """Writes `trajectory.tum` (every input frame) and `keyframes.tum`.

    Args:
        header: begin with a comment line.
    """

    def __init__(self, header: bool = True) -> None:
        self._header = header

    def export(self, result: RunResult, folder: Path) -> list[Path]:
        """Write both files; rows are `t tx ty tz qx qy qz qw`, camera to world, seconds."""
        from droidw.io.tum import write_tum
        from droidw.slam.frame import Trajectory

        keyframes = sorted(result.keyframes, key=lambda keyframe: keyframe.time)
        times = np.array([keyframe.time for keyframe in keyframes], dtype=np.float64)
        poses = np.array([keyframe.T_wc for keyframe in keyframes], dtype=np.float64)
        written = []
        for name, trajectory in (
            ("trajectory.tum", result.trajectory),
            ("keyframes.tum", Trajectory(times, poses.reshape(-1, 7))),
        ):
            write_tum(folder / name, trajectory, header=self._header)
            written.append(folder / name)
        return written


def _make(options: TrajectoryOptions, context: BuildContext) -> Exporter:
    return TrajectoryExporter(options.header)


COMPONENT: Component[Exporter] = Component(
    name="trajectory",
    summary="trajectory.tum (every input frame) and keyframes.tum, as evo reads them",
    factory=_make,
    options=TrajectoryOptions,
)
