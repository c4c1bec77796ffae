"""From targets at the cells of a grid to a flow field at every pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from droidw.geometry.projective import pixel_grid

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_types import Array, FlowFrame

__all__ = ["Raster"]

# Pixels by which a cell moves otherwise than those around it, from which on its depth is taken to
# be wrong: seen through that, all around it would be torn.
_STRAY = 2.0


class Raster:
    """Where the pixels of pictures lie on the grid; made once for each size.

    Args:
        stride: pixels per cell. offset: pixel coordinate of the first cell's centre.
    """

    def __init__(self, stride: int, offset: float) -> None:
        self._stride, self._offset = stride, offset
        self._placed: tuple[tuple[int, int], Any, Any] | None = None
        self._pixels: Array | None = None

    def dense(self, target: Array, a: FlowFrame, settled: bool = False) -> Array:
        """Grid targets [h,w,2] in cells as a full flow field [H,W,2] in pixels.

        Args:
            settled: cells that stray from those around them go with them.
        """
        flow = target * self._stride + self._offset - a.centres
        if settled:
            flow = _settled(flow)
        height, width = a.grey.shape
        map_x, map_y = self._maps(height, width)
        dense = cv2.remap(
            np.ascontiguousarray(flow, dtype=np.float32),
            map_x,
            map_y,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        bounded: Array = np.clip(dense, -2.0 * width, 2.0 * width).astype(np.float32)
        return bounded

    def pixels(self, height: int, width: int) -> Array:
        """Coordinates x, y of all pixels, [H,W,2]."""
        if self._pixels is None or self._pixels.shape[:2] != (height, width):
            self._pixels = pixel_grid(height, width).numpy()
        return self._pixels

    def _maps(self, height: int, width: int) -> tuple[Any, Any]:
        """Where every pixel lies on the grid, in the form that `cv2.remap` likes best."""
        if self._placed is None or self._placed[0] != (height, width):
            rows = np.float32(np.clip((np.arange(height) - self._offset) / self._stride, 0, None))
            cols = np.float32(np.clip((np.arange(width) - self._offset) / self._stride, 0, None))
            self._placed = ((height, width), *np.meshgrid(cols, rows))
        return self._placed[1], self._placed[2]


def _settled(flow: Array) -> Array:
    """Displacements [h,w,2], pixels; what strays from the median of its 3x3 becomes that median."""
    parts = [np.ascontiguousarray(part, dtype=np.float32) for part in np.moveaxis(flow, -1, 0)]
    median: Any = np.stack([cv2.medianBlur(part, 3) for part in parts], axis=-1)
    strays = np.abs(flow - median).max(axis=-1, keepdims=True) > _STRAY
    settled: Array = np.where(strays, median, flow)
    return settled
