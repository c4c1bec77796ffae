"""Depth priors: a depth map for a single image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.slam.frame import Frame

__all__ = ["DepthMap", "DepthPrior", "GoesWithFocal"]


@dataclass(frozen=True)
class DepthMap:
    """Depth along the optical axis, [H,W] float32 in metres or scene units; 0 where unknown."""

    depth: Tensor


@runtime_checkable
class DepthPrior(Protocol):
    """Predicts or looks up depth for keyframes.

    Attributes:
        metric: whether the depth is in metres, which makes the whole result metric.
    """

    metric: bool

    def predict(self, frame: Frame) -> DepthMap | None:
        """Depth of one keyframe at the size of `frame.image`, or None where there is none."""
        ...


@runtime_checkable
class GoesWithFocal(Protocol):
    """What a prior may say besides: twice the focal length makes its depths twice as large.

    So it is with a network that knows one camera, and has its depths scaled to that of the frame.
    Where global adjustment finds another focal length afterwards, the scale of the result follows.

    Attributes:
        goes_with_focal: whether it is so. What was measured is not.
    """

    goes_with_focal: bool
