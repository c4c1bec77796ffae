"""The extractor itself; imported only when it is chosen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch.nn import functional

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.geometry.camera import Grid

__all__ = ["GradientFeatures"]


class GradientFeatures:
    """Brightness, gradient in x and y, and its length, at several scales.

    Args:
        levels: number of scales; scale k is averaged over 2^(k+1) + 1 pixels squared.
        gain: factor on gradients, which are small beside brightness.
    """

    def __init__(self, levels: int = 3, gain: float = 4.0) -> None:
        self.dim = 4 * levels
        self._levels = levels
        self._gain = gain

    def extract(self, image: Tensor, grid: Grid) -> Tensor:
        """Features [dim,h,w] float32 of an image [3,H,W] in [0,1], at the cells of the grid."""
        grey = image.mean(dim=0)[None, None]
        maps = []
        for level in range(self._levels):
            radius = 2**level
            smooth = functional.avg_pool2d(
                functional.pad(grey, (radius,) * 4, mode="replicate"), 2 * radius + 1, stride=1
            )
            padded = functional.pad(smooth, (radius,) * 4, mode="replicate")
            centre = slice(radius, -radius)
            dx = (padded[..., centre, 2 * radius :] - padded[..., centre, : -2 * radius]) / 2
            dy = (padded[..., 2 * radius :, centre] - padded[..., : -2 * radius, centre]) / 2
            maps += [smooth, self._gain * dx, self._gain * dy, self._gain * torch.hypot(dx, dy)]
        return grid.sample(torch.cat(maps, dim=1)[0])
