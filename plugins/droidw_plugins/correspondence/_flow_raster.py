"""From targets at the cells of a grid to a flow field at every pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from droidw.geometry.projective import pixel_grid

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_types import Array, FlowFrame

__all__ = ["Expected", "Raster"]

# Pixels by which a cell moves otherwise than those around it, from which on its depth is taken to
# be wrong: seen through that, all around it would be torn.
_STRAY = 2.0
# Cells in a row, of which two second differences are known.
_FOUR = 4


class Raster:
    """Where the pixels of pictures lie on the grid; made once for each size.

    Args:
        stride: pixels per cell. offset: pixel coordinate of the first cell's centre.
    """

    def __init__(self, stride: int, offset: float) -> None:
        self._stride, self._offset = stride, offset
        self._placed: _Placed | None = None
        self._pixels: Array | None = None

    def dense(
        self, target: Array, a: FlowFrame, settled: bool = False, curved: bool = False
    ) -> Expected:
        """Grid targets [h,w,2] in cells as a full flow field in pixels.

        Args:
            settled: cells that stray from those around them go with them.
            curved: flow may bend between cells; else it is straight.
        """
        flow = np.ascontiguousarray(
            target * self._stride + self._offset - a.centres, dtype=np.float32
        )
        if settled:
            flow = _settled(flow)
        height, width = a.grey.shape
        placed = self._placed_on(height, width, flow.shape[:2])
        dense = _between(flow, placed.x, placed.y)
        bend = None
        if curved:
            across = _between(_bends(flow), placed.left, placed.y)
            down = _between(_bends(flow.swapaxes(0, 1)).swapaxes(0, 1), placed.x, placed.above)
            dense -= placed.across * across + placed.down * down
            bend = (across + down) / np.float32(self._stride**2)
        return Expected(np.clip(dense, -2.0 * width, 2.0 * width), bend)

    def pixels(self, height: int, width: int) -> Array:
        """Coordinates x, y of all pixels, [H,W,2]."""
        if self._pixels is None or self._pixels.shape[:2] != (height, width):
            self._pixels = pixel_grid(height, width).numpy()
        return self._pixels

    def _placed_on(self, height: int, width: int, grid: tuple[int, int]) -> _Placed:
        """Where every pixel lies on the grid [h,w]."""
        if self._placed is None or self._placed.x.shape != (height, width):
            rows = np.float32(np.clip((np.arange(height) - self._offset) / self._stride, 0, None))
            cols = np.float32(np.clip((np.arange(width) - self._offset) / self._stride, 0, None))
            x, y = np.meshgrid(cols, rows)
            left = np.minimum(np.floor(x), np.float32(grid[1] - 2))
            above = np.minimum(np.floor(y), np.float32(grid[0] - 2))
            self._placed = _Placed(x, y, left, above, _sag(x - left), _sag(y - above))
        return self._placed


class Expected(NamedTuple):
    """Flow that is expected at every pixel.

    Attributes:
        flow: [H,W,2] pixels.
        bend: [H,W,2] how it bends: its second derivatives along x and y in sum, pixels per square
            pixel, none at edges of depth; None where it was taken to be straight between cells.
    """

    flow: Array
    bend: Array | None


class _Placed(NamedTuple):
    """Where pixels [H,W] lie on the grid.

    Attributes:
        x, y: in cells. left, above: the cell before.
        across, down: [H,W,1] by what of a second difference a curve lies below its chord.
    """

    x: Array
    y: Array
    left: Array
    above: Array
    across: Array
    down: Array


def _sag(t: Array) -> Array:
    """By what of its second difference a parabola lies below its chord, at t in [0,1] of it."""
    inside: Array = np.clip(t, 0, 1)[..., None]
    return 0.5 * inside * (1 - inside)


def _between(values: Array, x: Array, y: Array) -> Array:
    """Values [h,w,2] of the grid at x, y [H,W] in cells, bilinear."""
    values = np.ascontiguousarray(values)
    found: Any = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    between: Array = found
    return between


def _bends(flow: Array) -> Array:
    """Second differences [h,w,2] along rows, from each cell to the next one.

    Of those at both ends it is the smaller one, and none where they have opposite signs: over an
    edge of depth flow leaps, and there is no curve to follow.
    """
    bends = np.zeros_like(flow)
    second = flow[:, 2:] - 2 * flow[:, 1:-1] + flow[:, :-2]
    one, other = second[:, :-1], second[:, 1:]
    smaller = np.where(np.abs(one) < np.abs(other), one, other)
    bends[:, 1:-2] = np.where(one * other > 0, smaller, 0)
    if flow.shape[1] >= _FOUR:  # at both ends of a row as beside them
        bends[:, 0], bends[:, -2] = bends[:, 1], bends[:, -3]
    return bends


def _settled(flow: Array) -> Array:
    """Displacements [h,w,2], pixels; what strays from the median of its 3x3 becomes that median."""
    parts = [np.ascontiguousarray(part, dtype=np.float32) for part in np.moveaxis(flow, -1, 0)]
    median: Any = np.stack([cv2.medianBlur(part, 3) for part in parts], axis=-1)
    strays = np.abs(flow - median).max(axis=-1, keepdims=True) > _STRAY
    settled: Array = np.where(strays, median, flow)
    return settled
