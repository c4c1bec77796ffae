"""Reader `bonn`: sequences of the Bonn RGB-D Dynamic dataset, colour pictures only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "BonnOptions"]


@dataclass(frozen=True)
class BonnOptions:
    """Options of the reader `bonn`."""

    max_difference: float = field(
        default=0.02,
        metadata={"help": "largest time between a picture and its true pose, in s", "gt": 0},
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.max_difference) and self.max_difference > 0):
            raise ValueError(f"max_difference must be positive, not {self.max_difference}")


def _make(options: BonnOptions, context: BuildContext) -> DatasetReader:
    from droidw_plugins.datasets._bonn import BonnReader
    from droidw_plugins.datasets._named import Datasets

    return BonnReader(options.max_difference, Datasets.of(context))


COMPONENT: Component[DatasetReader] = Component(
    name="bonn",
    summary="Bonn RGB-D Dynamic (bonn:balloon, or its folder), true poses moved to the camera",
    factory=_make,
    options=BonnOptions,
    reference="Palazzolo et al., ReFusion, IROS 2019; licence of the data not stated",
)
