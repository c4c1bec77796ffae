"""Exporter `uncertainty`: maps as 16-bit pictures, masks of what moves, a video to look at."""

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
    masks: bool = field(
        default=True, metadata={"help": "write masks/NNNNNN.png: 255 where something moves"}
    )
    mask_below: float = field(
        default=0.5,
        metadata={
            "help": "a mask marks what kept less than this share of its weight",
            "gt": 0,
            "le": 1,
        },
    )
    mask_outline: bool = field(
        default=False,
        metadata={
            "help": "masks end at contours of the picture up to a cell away, which cuts into what "
            "has contours of its own there (false: between cells)"
        },
    )
    video: bool = field(default=True, metadata={"help": "write uncertainty/overlay.mp4"})
    alpha: float = field(
        default=0.65,
        metadata={"help": "opacity of the video's tint where no weight is left", "ge": 0, "le": 1},
    )

    def __post_init__(self) -> None:
        if not 0 <= self.alpha <= 1:
            raise ValueError(f"alpha must lie between 0 and 1, not {self.alpha}")
        if not 0 < self.mask_below <= 1:
            raise ValueError(f"mask_below must lie in (0, 1], not {self.mask_below}")


def encode(uncertainty: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """A map as it is stored: uncertainty / SCALE, rounded, from 0 to 65535.

    65535 also stands for what is not a number: nothing vouches for that cell.
    """
    values = np.nan_to_num(uncertainty.astype(np.float64) / SCALE, nan=_LARGEST, posinf=_LARGEST)
    return np.clip(np.rint(values), 0, _LARGEST).astype(np.uint16)


class UncertaintyExporter:
    """Writes `uncertainty/` and `masks/`, nothing at all for a run without keyframes.

    `NNNNNN.png`, named by the index of the frame, is the map of one keyframe on the grid of the
    run, one 16-bit value per cell; it is not enlarged, since a cell is what was estimated. What
    the values mean is in `scale.json`. `overlay.mp4` shows the keyframes at working size, each
    from its own time on, tinted where uncertainty took away the weight in bundle adjustment.
    `masks/NNNNNN.png` is the same as black and white at working size, up to contours of the picture
    if that is asked for, and an input that `--masks` takes. Weights are those of bundle
    adjustment, the masks of the user included.

    Args:
        options: what to write.
    """

    def __init__(self, options: UncertaintyOptions | None = None) -> None:
        self._options = options or UncertaintyOptions()

    def export(self, result: RunResult, folder: Path) -> list[Path]:
        """Write maps and video.

        Raises:
            UsageError: the folder cannot be written to.
            MissingRequirementError: PyAV has no encoder; the maps are written all the same.
        """
        options = self._options
        if not result.keyframes:
            return []
        from droidw_plugins.exporters._maps import make_folder

        written = []
        if options.masks:
            make_folder(folder / "masks")
            written += self._write_masks(result, folder / "masks")
        folder = folder / "uncertainty"
        if options.maps or options.video:
            make_folder(folder)
        if options.maps:
            written += self._write_maps(result, folder)
        return written + ([self._write_video(result, folder)] if options.video else [])

    def _write_masks(self, result: RunResult, folder: Path) -> list[Path]:
        from droidw.geometry.contour import grown, outlined
        from droidw.geometry.spread import closed
        from droidw.io.files import write_json
        from droidw_plugins.exporters._maps import write_map

        height, width = result.keyframes[0].image.shape[:2]
        size, written = (width, height), []
        for keyframe in result.keyframes:
            below = self._options.mask_below
            mask = closed(keyframe.weight, result.stride, result.offset, size, below)
            if self._options.mask_outline:
                found = outlined(keyframe.image, mask, result.stride)
                mask = found | (grown(found, 1) & mask)  # the line along contours stays as it was
            path = folder / f"{keyframe.index:06d}.png"
            write_map(path, np.where(mask, 255, 0).astype(np.uint8))
            written.append(path)
        facts = {
            "mask": f"255: kept less than {self._options.mask_below:g} of its weight; 0: static",
            "ends": "at contours" if self._options.mask_outline else "between cells",
            "named": "index",
            "index": "of the frame in the source, counted from 0",
            "picture": list(size),
        }
        write_json(folder / "scale.json", facts)
        return [*written, folder / "scale.json"]

    def _write_maps(self, result: RunResult, folder: Path) -> list[Path]:
        from droidw.io.files import write_json
        from droidw_plugins.exporters._maps import write_map

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
        if result.rectification is not None:  # so that masks of raw pictures can be laid on cells
            facts["rectified"] = result.rectification.to_dict()
        write_json(path, facts)
        return [*written, path]

    def _write_video(self, result: RunResult, folder: Path) -> Path:
        from droidw_plugins.exporters._movie import write_movie
        from droidw_plugins.exporters._overlay import overlays

        keyframes = sorted(result.keyframes, key=lambda keyframe: keyframe.time)
        times = [keyframe.time for keyframe in keyframes]
        # Stamps count from the first frame of the run: times of day do not fit a small picture.
        first = float(result.trajectory.times[0]) if len(result.trajectory) else times[0]
        path = folder / "overlay.mp4"
        pictures = overlays(keyframes, result.stride, result.offset, first, self._options.alpha)
        write_movie(path, pictures, times)
        return path


def _make(options: UncertaintyOptions, context: BuildContext) -> Exporter:
    return UncertaintyExporter(options)


COMPONENT: Component[Exporter] = Component(
    name="uncertainty",
    summary="uncertainty/ and masks/: 16-bit maps and masks of the keyframes, an overlay video",
    factory=_make,
    options=UncertaintyOptions,
    requires=("av",),
    reference="video encoded by PyAV (BSD-3-Clause) on FFmpeg",
)
