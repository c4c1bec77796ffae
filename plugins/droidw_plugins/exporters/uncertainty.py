"""Exporter `uncertainty`: the maps as 16-bit pictures, and a video to look at them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.exporters import Exporter
    from droidw.slam.frame import RunResult

__all__ = ["COMPONENT", "SCALE", "UncertaintyExporter", "UncertaintyOptions", "encode"]

SCALE = 0.001
"""Uncertainty of one step of a map's value: fixed, so that maps of all runs compare."""

_LARGEST = 65535


@dataclass(frozen=True)
class UncertaintyOptions:
    """Options of the exporter `uncertainty`."""

    maps: bool = field(
        default=True, metadata={"help": "write the maps, uncertainty/NNNNNN.png and scale.json"}
    )
    video: bool = field(default=True, metadata={"help": "write uncertainty/overlay.mp4"})
    alpha: float = field(
        default=0.65,
        metadata={"help": "opacity of the video's tint where no weight is left", "ge": 0, "le": 1},
    )

    def __post_init__(self) -> None:
        if not 0 <= self.alpha <= 1:
            raise ValueError(f"alpha must lie between 0 and 1, not {self.alpha}")


def encode(uncertainty: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """A map as it is stored: uncertainty / SCALE, rounded, from 0 to 65535.

    65535 also stands for what is not a number: nothing vouches for that cell.
    """
    values = np.nan_to_num(uncertainty.astype(np.float64) / SCALE, nan=_LARGEST, posinf=_LARGEST)
    return np.clip(np.rint(values), 0, _LARGEST).astype(np.uint16)


class UncertaintyExporter:
    """Writes `uncertainty/` of the run folder, nothing at all for a run without keyframes.

    `NNNNNN.png`, named by the index of the frame, is the map of one keyframe on the grid of the
    run, one 16-bit value per cell; it is not enlarged, since a cell is what was estimated. What
    the values mean is in `scale.json`. `overlay.mp4` shows the keyframes at working size, each
    from its own time on, tinted where uncertainty took away the weight in bundle adjustment.

    Args:
        maps, video: what to write.
        alpha: opacity of the tint where no weight is left.
    """

    def __init__(self, maps: bool = True, video: bool = True, alpha: float = 0.65) -> None:
        self._maps, self._video, self._alpha = maps, video, alpha

    def export(self, result: RunResult, folder: Path) -> list[Path]:
        """Write maps and video.

        Raises:
            UsageError: the folder cannot be written to.
            MissingRequirementError: PyAV has no encoder; the maps are written all the same.
        """
        if not result.keyframes or not (self._maps or self._video):
            return []
        from droidw_plugins.exporters._maps import make_folder

        folder = folder / "uncertainty"
        make_folder(folder)
        written = self._write_maps(result, folder) if self._maps else []
        return written + ([self._write_video(result, folder)] if self._video else [])

    def _write_maps(self, result: RunResult, folder: Path) -> list[Path]:
        from droidw_plugins.exporters._maps import write_map, write_scale

        written = []
        for keyframe in result.keyframes:
            path = folder / f"{keyframe.index:06d}.png"
            write_map(path, encode(keyframe.uncertainty))
            written.append(path)
        path = folder / "scale.json"
        facts = {
            "uncertainty": "value * scale; larger means less static",
            "scale": SCALE,
            "largest": "65535: this much or more, or not a number",
            "grid": "cell (x, y) lies at pixel stride * (x, y) + offset of the working picture",
            "stride": result.stride,
            "offset": result.offset,
            "picture": [result.camera.width, result.camera.height],
        }
        write_scale(path, facts)
        return [*written, path]

    def _write_video(self, result: RunResult, folder: Path) -> Path:
        from droidw_plugins.exporters._movie import write_movie
        from droidw_plugins.exporters._overlay import overlays

        keyframes = sorted(result.keyframes, key=lambda keyframe: keyframe.time)
        times = [keyframe.time for keyframe in keyframes]
        # Stamps count from the first frame of the run: times of day do not fit a small picture.
        first = float(result.trajectory.times[0]) if len(result.trajectory) else times[0]
        path = folder / "overlay.mp4"
        pictures = overlays(keyframes, result.stride, result.offset, first, self._alpha)
        write_movie(path, pictures, times)
        return path


def _make(options: UncertaintyOptions, context: BuildContext) -> Exporter:
    return UncertaintyExporter(options.maps, options.video, options.alpha)


COMPONENT: Component[Exporter] = Component(
    name="uncertainty",
    summary="uncertainty/: 16-bit maps of the keyframes and an overlay video",
    factory=_make,
    options=UncertaintyOptions,
    requires=("av",),
    reference="video encoded by PyAV (BSD-3-Clause) on FFmpeg",
)
