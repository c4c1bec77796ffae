"""The built-in dataset readers, offered through the entry-point group `droidw`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from droidw.plugin.component import Component
from droidw.plugin.hookspecs import hookimpl

if TYPE_CHECKING:
    from droidw.interfaces.datasets import DatasetReader

__all__ = ["droidw_dataset_readers"]


@hookimpl
def droidw_dataset_readers() -> Iterable[Component[DatasetReader]]:
    """Light records only: the factory of each imports what it needs."""
    from droidw_plugins.datasets import (
        bonn,
        droidw,
        dycheck,
        euroc,
        folder,
        kitti,
        synthetic,
        tum,
        video,
    )

    yield bonn.COMPONENT
    yield droidw.COMPONENT
    yield dycheck.COMPONENT
    yield euroc.COMPONENT
    yield folder.COMPONENT
    yield kitti.COMPONENT
    yield synthetic.COMPONENT
    yield tum.COMPONENT
    yield video.COMPONENT
