"""Reader `tum`: sequences of the TUM RGB-D benchmark as they are downloaded."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "TumOptions"]


@dataclass(frozen=True)
class TumOptions:
    """Options of the reader `tum`."""

    max_difference: float = field(
        default=0.02,
        metadata={"help": "largest time between a picture and its true pose, in s", "gt": 0},
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.max_difference) and self.max_difference > 0):
            raise ValueError(f"max_difference must be positive, not {self.max_difference}")


def _make(options: TumOptions, context: BuildContext) -> DatasetReader:
    from droidw_plugins.datasets._named import Datasets
    from droidw_plugins.datasets._tum import TumReader

    return TumReader(options.max_difference, Datasets.of(context))


COMPONENT: Component[DatasetReader] = Component(
    name="tum",
    summary="TUM RGB-D benchmark (tum:freiburg3_walking_xyz, or its folder), colour pictures only",
    factory=_make,
    options=TumOptions,
    reference="Sturm et al., IROS 2012; data CC BY 4.0",
)
