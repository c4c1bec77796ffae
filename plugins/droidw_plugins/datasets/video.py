"""Reader `video`: a video file, with the presentation times that it gives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "VideoOptions"]


@dataclass(frozen=True)
class VideoOptions:
    """Options of the reader `video`."""

    fps: float = field(
        default=30.0, metadata={"help": "pictures a second, where the file does not tell", "gt": 0}
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"fps must be positive, not {self.fps}")


def _make(options: VideoOptions, context: BuildContext) -> DatasetReader:
    from droidw_plugins.datasets._video import VideoReader

    return VideoReader(options.fps)


COMPONENT: Component[DatasetReader] = Component(
    name="video",
    summary="a video file (mp4, mov, mkv, webm, avi, gif, ...) with its true times",
    factory=_make,
    options=VideoOptions,
    requires=("av",),
    reference="decoded by PyAV (BSD-3-Clause) on FFmpeg (LGPL)",
)
