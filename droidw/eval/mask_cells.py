"""Masks on the cells of uncertainty maps, by the way that the pictures went."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from droidw.errors import InputError
from droidw.eval.mask_files import listed
from droidw.geometry.camera import Grid
from droidw.geometry.rectify import Rectification
from droidw.io.masks import facts_of, written_by_droidw

__all__ = ["Cells", "check_shape", "resize_mask"]

_STRETCH = 0.05
"""Largest relative difference of two ratios of sides that counts as the same shape: cropping to
whole cells takes off a few pixels."""
_HALF = 0.5 - 1e-5
"""Half a cell; sums of shares may come out as 0.4999999."""


class Cells:
    """Lays masks on the cells of the maps of one run.

    What `scale.json` beside the maps says of lens, size and crop holds for masks as for pictures.
    Maps of another program, or of an older droidw, are taken to show what the masks show.

    Args:
        uncertainty, masks: the folders. source: that of the pictures, if it is known.
    """

    def __init__(self, uncertainty: Path, masks: Path, source: Path | None = None) -> None:
        facts = facts_of(uncertainty)
        self._shown = _shapes_shown(facts, masks, source)
        self._of_working = written_by_droidw(masks)
        self._way: Rectification | None = None
        self._grid: Grid | None = None
        try:
            way = Rectification.from_dict(facts["rectified"])
            width, height = way.size
            self._grid = Grid.of(height, width, int(facts["stride"]), float(facts["offset"]))
        except (KeyError, TypeError, ValueError, IndexError, InputError):
            return
        self._way = way
        self._shown = [way.size, (way.raw.width, way.raw.height), *self._shown]

    def lay(
        self, path: Path, mask: npt.NDArray[np.bool_], u: npt.NDArray[Any]
    ) -> npt.NDArray[np.bool_]:
        """The cells [h,w] bool of a map [h,w] of which a mask [H,W] marks at least half.

        Raises:
            InputError: the mask, whose file is named, does not show what the map shows.
        """
        check_shape(path, mask, u, self._shown)
        rows, columns = u.shape
        way, grid = self._way, self._grid
        if way is None or grid is None or (grid.height, grid.width) != (rows, columns):
            return resize_mask(mask, (rows, columns))
        working = self._shows_working(mask, way)
        shares = _resized(mask, way.size) if working else way.shares(mask)
        return np.asarray(grid.covered(torch.from_numpy(shares)).numpy() >= _HALF)

    def _shows_working(self, mask: npt.NDArray[np.bool_], way: Rectification) -> bool:
        """Whether a mask lies on working pictures: it is one of droidw, or has their shape."""
        width, height = mask.shape[::-1]
        raw = (way.raw.width, way.raw.height)
        if self._of_working or (width, height) == way.size != raw:
            return True
        off = [abs(width * h / (height * w) - 1) for w, h in (way.size, raw)]
        return bool(off[0] < off[1])


def _shapes_shown(
    facts: dict[str, Any], masks: Path, source: Path | None = None
) -> list[tuple[int, int]]:
    """Sizes (width, height) of which a mask may have the shape: working picture, raw picture.

    The first is what the facts beside the maps say, the second that of a picture beside the
    masks or in the source; what is not known is left out.
    """
    found = []
    try:
        width, height = (int(side) for side in facts["picture"])
        found.append((width, height))
    except (ValueError, KeyError, TypeError):
        pass  # maps of another program, or of an older droidw
    for _, _, path in listed(masks, source)[:1]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if picture is not None:
            found.append((picture.shape[1], picture.shape[0]))
    return [(width, height) for width, height in found if width > 0 and height > 0]


def check_shape(
    path: Path,
    mask: npt.NDArray[np.bool_],
    u: npt.NDArray[Any],
    shown: Sequence[tuple[int, int]] = (),
) -> None:
    """Refuse a mask whose sides have another ratio than those of the picture under its map.

    Args:
        path, mask: the mask [H,W] and its file. u: the map [h,w].
        shown: sizes of pictures that the mask may show; without any, the map itself tells the
            ratio as far as whole cells do.
    Raises:
        InputError: the mask does not show what the map shows.
    """
    height, width = mask.shape
    rows, columns = u.shape
    ratio = width / height
    if any(abs(ratio * h / w - 1) <= _STRETCH for w, h in shown):
        return
    least, most = columns / (rows + 1), (columns + 1) / rows
    slack = 1 + _STRETCH
    if not shown and min(least, columns / rows / slack) <= ratio <= max(
        most, columns / rows * slack
    ):
        return
    sizes = " or ".join(dict.fromkeys(f"{w}x{h}" for w, h in shown))
    raise InputError(
        f"{path}: a mask of {width}x{height} pixels does not fit "
        + (f"pictures of {sizes}" if sizes else f"uncertainty maps of {columns}x{rows} cells")
        + ": it has another shape",
        "masks may be of any size, but must show the whole picture; give those of this footage: "
        "--masks DIR",
    )


def resize_mask(mask: npt.NDArray[np.bool_], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Reduce a mask [H,W] to a grid [h,w]: True where at least half of a cell's area moves."""
    return np.asarray(_resized(mask, (shape[1], shape[0])) >= _HALF)


def _resized(mask: npt.NDArray[np.bool_], size: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Share [h,w] of each pixel of a size (width, height) that a mask marks."""
    marked = np.ascontiguousarray(mask, dtype=np.float32)
    height, width = mask.shape
    if (width, height) == size:
        return marked
    shrinks = size[0] <= width and size[1] <= height
    mode = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(marked, size, interpolation=mode), dtype=np.float32)
