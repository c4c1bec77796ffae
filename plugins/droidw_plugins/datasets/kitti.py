"""Reader `kitti`: sequences of the KITTI odometry benchmark."""

from __future__ import annotations

from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component, NoOptions

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["COMPONENT"]


def _make(options: NoOptions, context: BuildContext) -> DatasetReader:
    from droidw_plugins.datasets._kitti import KittiReader
    from droidw_plugins.datasets._named import Datasets

    return KittiReader(Datasets.of(context))


COMPONENT: Component[DatasetReader] = Component(
    name="kitti",
    summary="KITTI odometry (kitti:05, or its folder), left colour camera",
    factory=_make,
    reference="Geiger et al., CVPR 2012; data CC BY-NC-SA 3.0",
)
