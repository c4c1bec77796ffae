"""How much a picture moved, from flow alone: what makes it a keyframe."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from droidw.interfaces.correspondence import Motion

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_types import Array, FlowFrame
    from droidw_plugins.correspondence.flow import FlowOptions

__all__ = ["middles", "picture_motion"]

# Agreement in brightness below which a cell is not matched.
_AGREES = 0.3
# Matched cells of a tile that say how it moved.
_SOME = 2
# Share of the cells that has to be left besides those that may move by themselves.
_LEFT = 0.05


def picture_motion(
    moved: Array, agrees: Array, reference: FlowFrame, options: FlowOptions
) -> Motion:
    """Mean motion of a picture in cells, and the share of its cells that are matched.

    A camera at rest, before which most of the picture does not move, has the middle motion.

    Args:
        moved: [h,w,2] displacement of the cells of `reference`, pixels.
        agrees: [h,w] in [0,1], agreement in brightness at both ends.
    """
    textured = reference.texture.max(axis=-1) > 0.5 * options.texture
    usable = textured & (agrees > _AGREES)
    if not usable.any():
        return Motion(0.0, 0.0)
    if reference.aside is not None and (usable & ~reference.aside).mean() > _LEFT:
        usable &= ~reference.aside
    length = middles(np.hypot(moved[..., 0], moved[..., 1]), usable, options.motion_tiles)
    at_rest = (length < options.still).mean() > options.still_share
    flow = float(np.median(length) if at_rest else length.mean())
    return Motion(flow / reference.stride, float(usable.mean()))


def middles(values: Array, known: npt.NDArray[np.bool_], tiles: int) -> Array:
    """The median of what is known in each tile of a picture that has some of it, [n].

    A car that the camera follows stands still in the picture, and before a bare wall it has most of
    the structure: of all cells it would say that nothing moves, of all tiles it has few.

    Args:
        values, known: [h,w].
        tiles: rows and columns of tiles; 0: all known values themselves. These it is, too, where
            they are in fewer tiles than a row has.
    """
    single = values[known]
    if tiles == 0:
        return single
    row, column = (np.arange(size) * tiles // size for size in values.shape)
    tile = (row[:, None] * tiles + column)[known]
    count = np.bincount(tile, minlength=tiles * tiles)
    some = count >= _SOME
    if some.sum() < tiles:
        return single
    ordered = single[np.lexsort((single, tile))]
    first = np.cumsum(count) - count
    low, high = (first + (count - 1) // 2)[some], (first + count // 2)[some]
    median: Array = (ordered[low] + ordered[high]) / 2
    return median
