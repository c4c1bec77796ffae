"""Reader `bonn`: sequences of the Bonn RGB-D Dynamic dataset, colour pictures only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component
from droidw_plugins.datasets._options import PosedOptions

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "BonnOptions"]


@dataclass(frozen=True)
class BonnOptions(PosedOptions):
    """Options of the reader `bonn`."""


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
