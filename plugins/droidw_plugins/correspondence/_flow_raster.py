"""From targets at the cells of a grid to a flow field at every pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from droidw.geometry.projective import pixel_grid

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_types import Array, FlowFrame

__all__ = ["Expected", "Raster"]

# Pixels by which a cell moves otherwise than those around it, from which on its depth is taken to
# be wrong: seen through that, all around it would be torn.
_STRAY = 2.0
# Displacement of what is infinitely far off, pixels: beyond any picture.
_NOWHERE = 1e6
# Cells in a row, of which two second differences are known.
_FOUR = 4


class Raster:
    """Where the pixels of pictures lie on the grid; made once for each size.

    Args:
        stride: pixels per cell. offset: pixel coordinate of the first cell's centre.
    """

    def __init__(self, stride: int, offset: float) -> None:
        self._stride, self._offset = stride, offset
        self._placed: tuple[Any, Any, Array, Array] | None = None
        self._pixels: Array | None = None

    def dense(
        self, target: Array, a: FlowFrame, settled: bool = False, curved: bool = False
    ) -> Expected:
        """Grid targets [h,w,2] in cells as a full flow field in pixels.

        Args:
            settled: cells that stray from those around them go with them.
            curved: flow may bend between cells; else it is straight.
        """
        # OpenCV's search ends the process where it is to set out from what is no number.
        moved = np.nan_to_num(self.moved(target, a), posinf=_NOWHERE, neginf=-_NOWHERE)
        flow = np.ascontiguousarray(moved, dtype=np.float32)
        if settled:
            flow = _settled(flow)
        height, width = a.grey.shape
        x, y, across, down = self._placed_on(height, width)
        dense = np.asarray(
            cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
        )
        bend = None
        if curved:
            dense, bend = _curved(dense, flow, across, down)
            bend /= np.float32(self._stride**2)
        return Expected(np.clip(dense, -2.0 * width, 2.0 * width), bend)

    def moved(self, target: Array, a: FlowFrame) -> Array:
        """Displacements [h,w,2] px of the cells of `a` to targets [h,w,2] in cells."""
        return target * self._stride + self._offset - a.centres

    def targets(self, moved: Array, a: FlowFrame) -> Array:
        """Where displacements [h,w,2] px put the cells of `a`, [h,w,2] in cells."""
        at: Array = ((a.centres + moved - self._offset) / self._stride).astype(np.float32)
        return at

    def pixels(self, height: int, width: int) -> Array:
        """Coordinates x, y of all pixels, [H,W,2]."""
        if self._pixels is None or self._pixels.shape[:2] != (height, width):
            self._pixels = pixel_grid(height, width).numpy()
        return self._pixels

    def _placed_on(self, height: int, width: int) -> tuple[Any, Any, Array, Array]:
        """Where pixels lie on the grid, in cells: of each, x, y [H,W]; of columns, rows."""
        if self._placed is None or self._placed[0].shape != (height, width):
            rows = np.float32(np.clip((np.arange(height) - self._offset) / self._stride, 0, None))
            cols = np.float32(np.clip((np.arange(width) - self._offset) / self._stride, 0, None))
            # In the form that `cv2.remap` likes best.
            self._placed = (*np.meshgrid(cols, rows), cols, rows)
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


def _curved(dense: Array, flow: Array, across: Array, down: Array) -> tuple[Array, Array]:
    """Flow of pixels [H,W,2] that runs straight between cells, bent as that of cells [h,w,2] does.

    A parabola lies below its chord by half its second difference times t (1 - t), t from 0 to 1.

    Args:
        dense: is overwritten. across: columns [W] in cells. down: rows [H].
    Returns:
        bent flow, and second differences along x and y in sum, both [H,W,2].
    """
    left, t = _before(across, flow.shape[1])
    above, s = _before(down, flow.shape[0])
    t, s = np.repeat(t, 2).reshape(-1, 2), s[:, None, None]
    x, y = _bends(flow), _bends(flow.swapaxes(0, 1)).swapaxes(0, 1)
    x = np.take(_lerped(x, above, s, 0), left, axis=1)
    y = np.take(_lerped(y, left, t, 1), above, axis=0)
    dense -= 0.5 * t * (1 - t) * x
    dense -= 0.5 * s * (1 - s) * y
    x += y
    return dense, x


def _before(at: Array, count: int) -> tuple[npt.NDArray[np.intp], Array]:
    """The cell before each place [n] in a row of so many, and how far on to the next it lies."""
    cell = np.minimum(at.astype(np.intp), max(count - 2, 0))
    return cell, np.clip(at - cell, 0, 1).astype(np.float32)


def _lerped(values: Array, cell: npt.NDArray[np.intp], t: Array, axis: int) -> Array:
    """Values [h,w,2] at places [n] along an axis, `t` on from a cell to the next one."""
    after = np.minimum(cell + 1, values.shape[axis] - 1)
    between: Array = np.take(values, cell, axis) * (1 - t) + np.take(values, after, axis) * t
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
