"""Reader `tum`: sequences of the TUM RGB-D benchmark as they are downloaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component
from droidw_plugins.datasets._options import PosedOptions

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT", "TumOptions"]


@dataclass(frozen=True)
class TumOptions(PosedOptions):
    """Options of the reader `tum`."""


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
