"""Reader `euroc`: sequences of the EuRoC MAV dataset, left camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component
from droidw_plugins.datasets._options import PosedOptions

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "EurocOptions"]


@dataclass(frozen=True)
class EurocOptions(PosedOptions):
    """Options of the reader `euroc`."""


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
