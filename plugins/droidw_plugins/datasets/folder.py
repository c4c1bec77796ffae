"""Reader `folder`: pictures in a folder, with or without times and a calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "FolderOptions"]


@dataclass(frozen=True)
class FolderOptions:
    """Options of the reader `folder`."""

    fps: float = field(
        default=30.0, metadata={"help": "pictures a second, where nothing else tells", "gt": 0}
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"fps must be positive, not {self.fps}")


def _make(options: FolderOptions, context: BuildContext) -> DatasetReader:
    from droidw_plugins.datasets._folder import FolderReader

    return FolderReader(options.fps)


COMPONENT: Component[DatasetReader] = Component(
    name="folder",
    summary="pictures in a folder; rgb.txt, camera.txt and groundtruth.txt are used if there",
    factory=_make,
    options=FolderOptions,
)
