"""What parts answer while they run, held to the protocol of their kind."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from droidw.errors import PluginError
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.interfaces.depth import DepthMap
from droidw.interfaces.uncertainty import UncertaintyReport
from droidw.slam.frame import RawFrame
from droidw.solve.problem import Step

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid
    from droidw.interfaces.correspondence import EdgeRequest
    from droidw.solve.problem import BAProblem

__all__ = [
    "depth_of", "energy_of", "features_of", "frame_of", "movable_of", "step_of", "update_of",
]  # fmt: skip

_MORE = "; the checks in droidw.testing find more (docs/plugins.md)"


def features_of(found: object, dim: int, grid: Grid) -> Tensor:
    """The maps that a feature extractor gives of a frame.

    Raises:
        PluginError: they are no tensor [dim,h,w] on the grid, or not finite (which is asked on a
            CPU alone: a GPU would have to be waited for).
    """
    wanted = (dim, grid.height, grid.width)
    if not isinstance(found, Tensor) or tuple(found.shape) != wanted:
        raise PluginError(
            f"the feature extractor breaks its contract: `extract` returned {_told(found)}, not a "
            f"tensor {list(wanted)} (dim, rows and columns of the grid)",
            "return one value per cell and channel: grid.sample(map) reads a map at the cells"
            + _MORE,
        )
    if found.device.type == "cpu" and not _finite(found):
        raise PluginError(
            "the feature extractor breaks its contract: `extract` returned values that are not "
            "finite",
            "look for a division by 0, or values beyond half precision" + _MORE,
        )
    return found


def movable_of(found: object, grid: Grid) -> Tensor:
    """The map [h,w] in [0,1] that an extractor gives of what can move.

    Raises:
        PluginError: it is no such tensor (values are looked at on a CPU alone).
    """
    wanted = (grid.height, grid.width)
    fits = isinstance(found, Tensor) and tuple(found.shape) == wanted
    if not isinstance(found, Tensor) or not fits or not found.is_floating_point():
        said = _told(found)
    elif found.device.type != "cpu" or bool(((found >= 0) & (found <= 1)).all()):
        return found.to(torch.float32)
    else:
        said = "values outside [0, 1]"
    raise PluginError(
        f"the feature extractor breaks its contract: `movable` returned {said}, not a tensor "
        f"{list(wanted)} of shares in [0, 1]",
        "return one share per cell of the grid" + _MORE,
    )


def frame_of(found: object, before: RawFrame | None = None) -> RawFrame:
    """The next raw picture of a reader.

    Args:
        found: what came. before: the picture before it.
    Raises:
        PluginError: it is no RawFrame of uint8 [H,W,3] with a finite time, or its time or index is
            not larger than those before.
    """
    if not isinstance(found, RawFrame):
        said = f"{type(found).__name__}, no RawFrame"
    elif not _is_picture(found.image):
        kind = getattr(found.image, "dtype", "")
        said = f"a picture that is {_told(found.image)} {kind}".rstrip() + ", not uint8 [H,W,3]"
    elif not math.isfinite(found.time):
        said = f"the time {found.time}"
    elif before is not None and not (found.time > before.time and found.index > before.index):
        said = (
            f"picture {found.index} at {found.time:.10g} s after picture {before.index} at "
            f"{before.time:.10g} s"
        )
    else:
        return found
    raise PluginError(
        f"the reader breaks its contract: `frames` gave {said}",
        "give RGB pictures of whole numbers, with times in seconds and indices that rise" + _MORE,
    )


def _is_picture(image: object) -> bool:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        return False
    return image.ndim == 3 and image.shape[2] == 3


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


def update_of(found: object, request: EdgeRequest) -> EdgeUpdate:
    """What correspondence answers of edges.

    Raises:
        PluginError: it is no EdgeUpdate of float32: target [E,h,w,2], confidence [E,h,w,2 or 3].
    """
    wanted, either = tuple(request.coords.shape), (2, 3)
    if not isinstance(found, EdgeUpdate):
        said = f"{type(found).__name__}, no EdgeUpdate"
    elif not _fits(found.target, wanted):
        said = f"a target that is {_told(found.target)}, not float32 {list(wanted)}"
    elif not any(_fits(found.confidence, (*wanted[:-1], channels)) for channels in either):
        said = (
            f"a confidence that is {_told(found.confidence)}, not float32 "
            f"{[*wanted[:-1], '2 or 3']}"
        )
    else:
        return found
    raise PluginError(
        f"the correspondence operator breaks its contract: `update` returned {said}",
        "return one target and the information of it for each edge and cell" + _MORE,
    )


def step_of(found: object, problem: BAProblem) -> Step:
    """What a bundle adjustment backend makes of a problem.

    A step that is not finite is left out: state stays as it was, and the report says so. (On a GPU
    that is not asked: it would have to be waited for.)

    Raises:
        PluginError: it is no Step of poses and disparities like those of the problem.
    """
    if not isinstance(found, Step):
        said = f"{type(found).__name__}, no Step"
    elif not isinstance(found.T_cw, Tensor) or found.T_cw.shape != problem.T_cw.shape:
        said = f"poses that are {_told(found.T_cw)}, not {list(problem.T_cw.shape)}"
    elif not isinstance(found.disps, Tensor) or found.disps.shape != problem.disps.shape:
        said = f"disparities that are {_told(found.disps)}, not {list(problem.disps.shape)}"
    elif found.disps.device.type != "cpu" or (_finite(found.T_cw) and _finite(found.disps)):
        return found
    else:
        report = replace(found.report, status="nonfinite")
        return Step(problem.T_cw.clone(), problem.disps.clone(), report)
    raise PluginError(
        f"the bundle adjustment backend breaks its contract: `step` returned {said}",
        "return droidw.solve.problem.Step of new poses [N,7] and disparities [N,h,w]" + _MORE,
    )


def _fits(value: object, shape: tuple[int, ...]) -> bool:
    return (
        isinstance(value, Tensor) and tuple(value.shape) == shape and value.dtype == torch.float32
    )


def _finite(values: Tensor) -> bool:
    return bool(torch.isfinite(values).all())


def _told(value: object) -> str:
    shape = getattr(value, "shape", None)
    shape = f" {list(shape)}" if isinstance(shape, tuple) else ""
    kind = type(value).__name__
    if isinstance(value, torch.Tensor):
        kind = "a tensor" if value.dtype == torch.float32 else f"a {value.dtype} tensor"
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
