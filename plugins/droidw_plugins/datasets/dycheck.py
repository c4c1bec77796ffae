"""Reader `dycheck`: scenes of the DyCheck iPhone dataset, with poses of COLMAP as truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "DycheckOptions"]


@dataclass(frozen=True)
class DycheckOptions:
    """Options of the reader `dycheck`."""

    fps: float = field(
        default=30.0, metadata={"help": "pictures a second; the files only count them", "gt": 0}
    )
    normalise: bool = field(
        default=True,
        metadata={"help": "true positions in units of the way from the first to the last"},
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"fps must be positive, not {self.fps}")


def _make(options: DycheckOptions, context: BuildContext) -> DatasetReader:
    from droidw_plugins.datasets._dycheck import DycheckReader
    from droidw_plugins.datasets._named import Datasets

    return DycheckReader(options.fps, options.normalise, Datasets.of(context))


COMPONENT: Component[DatasetReader] = Component(
    name="dycheck",
    summary="DyCheck iPhone scenes (dycheck:apple, or a folder with dense/images)",
    factory=_make,
    options=DycheckOptions,
    reference="Gao et al., NeurIPS 2022; layout of Shape of Motion; licence of the data not stated",
)
