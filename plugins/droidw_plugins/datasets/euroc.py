"""Reader `euroc`: sequences of the EuRoC MAV dataset, left camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "EurocOptions"]


@dataclass(frozen=True)
class EurocOptions:
    """Options of the reader `euroc`."""

    max_difference: float = field(
        default=0.02,
        metadata={"help": "largest time between a picture and its true pose, in s", "gt": 0},
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.max_difference) and self.max_difference > 0):
            raise ValueError(f"max_difference must be positive, not {self.max_difference}")


def _make(options: EurocOptions, context: BuildContext) -> DatasetReader:
    from droidw_plugins.datasets._euroc import EurocReader
    from droidw_plugins.datasets._named import Datasets

    return EurocReader(options.max_difference, Datasets.of(context))


COMPONENT: Component[DatasetReader] = Component(
    name="euroc",
    summary="EuRoC MAV (euroc:MH_01_easy, or its folder), left camera",
    factory=_make,
    options=EurocOptions,
    reference="Burri et al., IJRR 2016; licence of the data not stated",
)
