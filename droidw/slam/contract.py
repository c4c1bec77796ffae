"""What parts answer while they run, held to the protocol of their kind."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from droidw.errors import PluginError
from droidw.interfaces.depth import DepthMap
from droidw.interfaces.uncertainty import UncertaintyReport

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid

__all__ = ["depth_of", "energy_of", "features_of"]

_MORE = "; the checks in droidw.testing find more (docs/plugins.md)"


def features_of(found: object, dim: int, grid: Grid) -> Tensor:
    """The maps that a feature extractor gives of a frame.

    Raises:
        PluginError: they are no tensor [dim,h,w] on the grid.
    """
    wanted = (dim, grid.height, grid.width)
    if not isinstance(found, Tensor) or tuple(found.shape) != wanted:
        raise PluginError(
            f"the feature extractor breaks its contract: `extract` returned {_told(found)}, not a "
            f"tensor {list(wanted)} (dim, rows and columns of the grid)",
            "return one value per cell and channel: grid.sample(map) reads a map at the cells"
            + _MORE,
        )
    return found


def depth_of(found: object, height: int, width: int) -> Tensor | None:
    """The map [H,W] that a depth prior gives of a frame, or None where it has none.

    Raises:
        PluginError: it is neither None nor a DepthMap at the size of the picture.
    """
    if found is None:
        return None
    depth = found.depth if isinstance(found, DepthMap) else found
    fits = isinstance(depth, Tensor) and tuple(depth.shape) == (height, width)
    if not isinstance(found, DepthMap) or not fits:
        what = "a DepthMap of " if isinstance(found, DepthMap) else ""
        raise PluginError(
            f"the depth prior breaks its contract: `predict` returned {what}{_told(depth)}, not a "
            f"DepthMap of a tensor [{height}, {width}] (the size of frame.image) or None",
            "return droidw.interfaces.depth.DepthMap(depth)" + _MORE,
        )
    return found.depth


def _told(value: object) -> str:
    shape = getattr(value, "shape", None)
    shape = f" {list(shape)}" if isinstance(shape, tuple) else ""
    kind = "a tensor" if isinstance(value, torch.Tensor) else type(value).__name__
    return f"{kind}{shape}"


def energy_of(report: object) -> float:
    """The energy that an uncertainty model reports of an update.

    Raises:
        PluginError: it is no report.
    """
    if not isinstance(report, UncertaintyReport):
        raise PluginError(
            "the uncertainty model breaks its contract: `update` returned "
            f"{type(report).__name__}, no UncertaintyReport",
            "return droidw.interfaces.uncertainty.UncertaintyReport(energy=...)" + _MORE,
        )
    return report.energy
