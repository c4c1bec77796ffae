"""Where bundle adjustment of the first keyframes can be started from.

Nothing is known of them, and Gauss-Newton ends in the nearest valley. A camera that moves sideways
looks much like one that turns, a scene seen from afar much like the same turned inside out; so
several starts are tried, and the one that explains the measurements best is kept.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from droidw.geometry.se3 import exp, mul

__all__ = ["mirrored", "plane_starts"]

# Step between keyframes in plane depths: a hint of a direction, not a guess of a length.
_HINT = 0.02


def mirrored(T_cw: Tensor, disps: Tensor) -> tuple[Tensor, Tensor]:
    """The scene with its depth turned inside out, and the camera moving the other way.

    The turn makes the middle of the picture move as before. Seen from afar, this explains the
    flow almost as well.

    Args:
        T_cw: [N,7]. disps: [N,h,w].
    Returns:
        Poses and disparities of the same shapes.
    """
    mean = disps.mean(dim=(1, 2), keepdim=True)
    t = T_cw[:, :3]
    turn = torch.zeros_like(T_cw[:, :6])
    middle = mean[:, 0, 0].mean()
    turn[:, 3] = -2.0 * middle * t[:, 1]
    turn[:, 4] = 2.0 * middle * t[:, 0]
    poses = mul(exp(turn), T_cw)
    poses[:, :3] = -t * t.new_tensor([1.0, 1.0, 0.0])
    return poses, (2.0 * mean - disps).clamp_min(0.1 * mean)


def plane_starts(disps: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """A plane before a camera that rests, then one that drifts along each axis, either way.

    Args:
        disps: [N,h,w], for shape and device.
    Yields:
        Poses [N,7] and disparities [N,h,w] of ones.
    """
    count = len(disps)
    steps = torch.arange(count, dtype=disps.dtype, device=disps.device)[:, None] * _HINT
    axes = torch.eye(3, dtype=disps.dtype, device=disps.device)
    for way in (torch.zeros_like(axes[0]), *axes, *(-axes)):
        T_cw = disps.new_zeros(count, 7)
        T_cw[:, :3] = steps * way
        T_cw[:, 6] = 1.0
        yield T_cw, torch.ones_like(disps)
