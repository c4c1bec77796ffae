"""Exporter `ply`: the static point cloud."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from droidw.plugin.component import BuildContext, Component, NoOptions

if TYPE_CHECKING:
    from droidw.interfaces.exporters import Exporter
    from droidw.slam.frame import RunResult

__all__ = ["COMPONENT", "PlyExporter"]

_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)
_TYPES = {"<f4": "float", "|u1": "uchar"}


class PlyExporter:
    """Writes `points.ply`, binary little-endian, in the world frame and scene units."""

    def export(self, result: RunResult, folder: Path) -> list[Path]:
        """Write the cloud; points that are not finite are left out."""
        from droidw.io.files import atomic_write

        cloud = result.cloud
        finite = np.isfinite(cloud.xyz).all(axis=1)
        table = np.empty(int(finite.sum()), dtype=_VERTEX)
        for axis, name in enumerate(("x", "y", "z")):
            table[name] = cloud.xyz[finite, axis]
        for channel, name in enumerate(("red", "green", "blue")):
            table[name] = cloud.rgb[finite, channel]
        header = [
            "ply",
            "format binary_little_endian 1.0",
            "comment droidw: static points in the world frame, scene units",
            f"element vertex {len(table)}",
            *(f"property {_TYPES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()),
            "end_header",
        ]
        path = folder / "points.ply"
        with atomic_write(path) as stream:
            stream.write(("\n".join(header) + "\n").encode("ascii"))
            stream.write(table.tobytes())
        return [path]


def _make(options: NoOptions, context: BuildContext) -> Exporter:
    return PlyExporter()


COMPONENT: Component[Exporter] = Component(
    name="ply",
    summary="points.ply, the coloured static point cloud",
    factory=_make,
)
