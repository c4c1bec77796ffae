"""Reader `droidw`: the outdoor walks of DROID-W, and its YouTube clips."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "DroidwOptions"]


@dataclass(frozen=True)
class DroidwOptions:
    """Options of the reader `droidw`."""

    max_difference: float = field(
        default=0.1,
        metadata={"help": "largest time between a picture and its true pose, in s", "gt": 0},
    )
    fps: float = field(
        default=30.0, metadata={"help": "pictures a second of the YouTube clips", "gt": 0}
    )

    def __post_init__(self) -> None:
        for name in ("max_difference", "fps"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, not {value}")


def _make(options: DroidwOptions, context: BuildContext) -> DatasetReader:
    from droidw_plugins.datasets._droidw import DroidwReader
    from droidw_plugins.datasets._named import Datasets

    return DroidwReader(options.max_difference, options.fps, Datasets.of(context))


COMPONENT: Component[DatasetReader] = Component(
    name="droidw",
    summary="DROID-W walks (droidw:downtown1) with RTK or FAST-LIVO2 truth, and youtube:giraffe",
    factory=_make,
    options=DroidwOptions,
    reference="Li et al., DROID-SLAM in the Wild, CVPR 2026; licence of the data not stated",
)
