"""Exporter `depth`: depth maps of the keyframes, as pictures and as numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.exporters import Exporter
    from droidw.slam.frame import RunResult

__all__ = ["COMPONENT", "DepthExporter", "DepthOptions", "encode", "scale_for"]

_LARGEST = 65535


@dataclass(frozen=True)
class DepthOptions:
    """Options of the exporter `depth`."""

    all: bool = field(
        default=False,
        metadata={"help": "also put into the pictures what other keyframes do not confirm"},
    )
    png: bool = field(
        default=True, metadata={"help": "write the pictures, depth/NNNNNN.png and scale.json"}
    )
    npz: bool = field(default=True, metadata={"help": "write depth/depth.npz"})
    full: bool = field(
        default=False,
        metadata={
            "help": "also write pictures at the full size, depth/full/NNNNNN.png, where "
            "correspondence enlarges depth itself (droid)"
        },
    )
    scale: float = field(
        default=0.0,
        metadata={
            "help": "scene units per step of a picture's value (0: the power of ten that gives "
            "the median depth a value of 1000 to 9999)",
            "ge": 0,
        },
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale >= 0):
            raise ValueError(f"scale must be 0 or more, not {self.scale}")


def scale_for(depths: npt.NDArray[np.float32]) -> float:
    """The power of ten that gives the median of these depths (> 0) a value of 1000 to 9999.

    Scene units have no fixed length. Where the median depth is 1 to 10 of them this gives
    0.001, which other programs expect: millimetres, if a unit is a metre.
    """
    if not depths.size:
        return 0.001
    return float(f"1e{math.floor(math.log10(float(np.median(depths)))) - 3}")


def encode(
    depth: npt.NDArray[np.float32], keep: npt.NDArray[np.bool_], scale: float
) -> npt.NDArray[np.uint16]:
    """Depth as it is stored in a picture: depth / scale, rounded, at least 1; 0 for unknown.

    What is not kept, and what is too far for 16 bits, is 0: a wrong depth is worse than none.
    """
    values = np.maximum(np.rint(depth.astype(np.float64) / scale), 1)
    return np.where(keep & (values <= _LARGEST), values, 0).astype(np.uint16)


class DepthExporter:
    """Writes `depth/` of the run folder, nothing at all for a run without keyframes.

    `NNNNNN.png`, named by the index of the frame, holds the depth of one keyframe on the grid of
    the run, one 16-bit value per cell: depth = value * scale, in scene units, 0 where unknown or
    not confirmed by other keyframes. The scale is in `scale.json`. `full/NNNNNN.png`, if asked for,
    is the same at the size of the working picture.

    `depth.npz` holds what was estimated, K keyframes on a grid of h x w cells: `depth` [K,h,w]
    float32 in scene units (0 where there is none), `valid` [K,h,w] bool (confirmed by other
    keyframes), `index` [K] int64, `time` [K] float64 in seconds, `T_wc` [K,7] float64 (camera to
    world, translation then quaternion xyzw), `intrinsics` [K,4] float64 (fx, fy, cx, cy in cells
    of the grid, cell centres at integers).

    Args:
        all: also put unconfirmed depth into the pictures.
        png, npz, full: what to write; `full` needs `png`.
        scale: scene units per step of a picture's value, 0 to choose one.
    """

    def __init__(
        self,
        all: bool = False,
        png: bool = True,
        npz: bool = True,
        scale: float = 0.0,
        full: bool = False,
    ) -> None:
        self._all, self._png, self._npz, self._scale, self._full = all, png, npz, scale, full

    def export(self, result: RunResult, folder: Path) -> list[Path]:
        """Write pictures and numbers.

        Raises:
            UsageError: the folder cannot be written to.
        """
        if not result.keyframes or not (self._png or self._npz):
            return []
        from droidw_plugins.exporters._maps import make_folder

        folder = folder / "depth"
        make_folder(folder)
        disp = np.stack([keyframe.disp for keyframe in result.keyframes]).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.reciprocal(disp)
        known = np.isfinite(depth) & (depth > 0)
        depth = np.where(known, depth, 0).astype(np.float32)
        valid = known & np.stack([keyframe.depth_valid for keyframe in result.keyframes])
        written = []
        if self._png:
            written += self._pictures(result, depth, known if self._all else valid, folder)
        if self._npz:
            written.append(_write_numbers(result, depth, valid, folder))
        return written

    def _pictures(
        self,
        result: RunResult,
        depth: npt.NDArray[np.float32],
        keep: npt.NDArray[np.bool_],
        folder: Path,
    ) -> list[Path]:
        from droidw.io.files import write_json
        from droidw_plugins.exporters._maps import write_map

        scale = self._scale or scale_for(depth[keep])
        written, too_far = [], 0
        for keyframe, one, kept in zip(result.keyframes, depth, keep, strict=True):
            values = encode(one, kept, scale)
            too_far += int((kept & (values == 0)).sum())
            path = folder / f"{keyframe.index:06d}.png"
            write_map(path, values)
            written.append(path)
        metric = str(result.manifest.get("scale", "")).startswith("metric")
        unit = "metres" if metric else "scene units"
        facts: dict[str, Any] = {
            "depth": f"value * scale, along the optical axis, in {unit}; 0 is unknown",
            "scale": scale,
            "unit": unit,
            "named": "index",
            "unconfirmed": "written" if self._all else "0",
            "median_depth": float(np.median(depth[keep])) if keep.any() else None,
            "cells_too_far": too_far,
            "grid": "cell (x, y) lies at pixel stride * (x, y) + offset of the working picture",
            "stride": result.stride,
            "offset": result.offset,
            "picture": [result.camera.width, result.camera.height],
        }
        path = folder / "scale.json"
        write_json(path, facts)
        if self._full:
            written += _enlarged(result, keep, scale, folder / "full")
        return [*written, path]


def _enlarged(
    result: RunResult, keep: npt.NDArray[np.bool_], scale: float, folder: Path
) -> list[Path]:
    """Pictures at the full size of all keyframes that have such a map."""
    from droidw_plugins.exporters._maps import make_folder, write_map

    written = []
    for keyframe, kept in zip(result.keyframes, keep, strict=True):
        disp = keyframe.disp_full
        if disp is None:
            continue
        make_folder(folder)
        # The fine values of a cell begin at its pixel and go on to the next.
        rows, columns = (np.arange(side) // result.stride for side in disp.shape)
        fine = kept[rows[:, None], columns] & np.isfinite(disp) & (disp > 0)
        depth = np.divide(1.0, disp, out=np.zeros_like(disp), where=fine)
        path = folder / f"{keyframe.index:06d}.png"
        write_map(path, encode(depth, fine, scale))
        written.append(path)
    return written


def _write_numbers(
    result: RunResult,
    depth: npt.NDArray[np.float32],
    valid: npt.NDArray[np.bool_],
    folder: Path,
) -> Path:
    import torch

    from droidw.geometry.camera import Grid
    from droidw.io.files import atomic_write

    keyframes = result.keyframes
    grid = Grid(depth.shape[1], depth.shape[2], result.stride, result.offset)
    intrinsics = np.stack([keyframe.intrinsics for keyframe in keyframes]).astype(np.float64)
    path = folder / "depth.npz"
    with atomic_write(path) as stream:
        np.savez_compressed(
            stream,
            depth=depth,
            valid=valid,
            index=np.array([keyframe.index for keyframe in keyframes], dtype=np.int64),
            time=np.array([keyframe.time for keyframe in keyframes], dtype=np.float64),
            T_wc=np.stack([keyframe.T_wc for keyframe in keyframes]).astype(np.float64),
            intrinsics=grid.intrinsics(torch.from_numpy(intrinsics)).numpy(),
        )
    return path


def _make(options: DepthOptions, context: BuildContext) -> Exporter:
    return DepthExporter(options.all, options.png, options.npz, options.scale, options.full)


COMPONENT: Component[Exporter] = Component(
    name="depth",
    summary="depth/: 16-bit depth pictures of the keyframes, and their numbers as NPZ",
    factory=_make,
    options=DepthOptions,
)
