"""Poses between two known poses, along the screw motion that joins them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from droidw.geometry import se3
from droidw.geometry.transfer import on_device

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["interpolate"]


def interpolate(T_a: Tensor, T_b: Tensor, s: Tensor | float) -> Tensor:
    """exp(s log(T_b T_a^-1)) T_a: T_a at s = 0, T_b at s = 1, extrapolated outside (REFERENCE 5.8).

    Args:
        T_a, T_b: [..., 7]; both world to camera, or both camera to world.
        s: share of the way, a number or a tensor [...] that broadcasts with the poses.

    Returns:
        [..., 7] with unit quaternions.
    """
    if isinstance(s, torch.Tensor):
        share = s.to(T_a)[..., None]
    else:
        share = on_device([s], T_a.device, T_a.dtype)
    return se3.retract(T_a, share * se3.log(se3.mul(T_b, se3.inv(T_a))))
