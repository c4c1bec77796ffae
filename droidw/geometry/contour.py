"""Masks that end at the contours of a picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

__all__ = ["grown", "outlined"]

# Blur of the picture in which contours are looked for, pixels, and the mark of what lies inside.
_BLUR = 0.8
_INSIDE = 2


def grown(mask: npt.NDArray[np.bool_], margin: int) -> npt.NDArray[np.bool_]:
    """The mask [H,W] and what lies up to `margin` pixels around it, in rows and columns."""
    size = 2 * margin + 1
    wide: Any = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8))
    covered: npt.NDArray[np.bool_] = wide > 0
    return covered


def outlined(
    picture: npt.NDArray[np.uint8], closed: npt.NDArray[np.bool_], reach: int
) -> npt.NDArray[np.bool_]:
    """What a mask [H,W] covers of a picture, up to the contours that it has there.

    A cell of a grid that is covered in part is closed as a whole. Only what lies `reach` pixels
    inside and outside of the border of the mask is taken for known; from both, basins are flooded
    over the slopes of the picture until they meet (watershed: Meyer, Color image segmentation,
    1992). What belongs to neither stays open: a line a pixel wide between them and the frame of
    the picture. Parts of the mask that have no inside stay as they are.

    Args:
        picture: [H,W] grey or [H,W,3] uint8.
        closed: [H,W], True where it is covered.
        reach: pixels by which the border may be moved, such as the side of a cell.
    """
    inside, outside = ~grown(~closed, reach), ~grown(closed, reach)
    if not outside.any():
        return closed
    parts: Any = cv2.connectedComponents(closed.astype(np.uint8), connectivity=8)[1]
    inside |= closed & ~np.isin(parts, parts[inside])
    marks = np.where(inside, _INSIDE, outside).astype(np.int32)
    soft: Any = cv2.GaussianBlur(picture, (0, 0), _BLUR)
    basins: Any = cv2.watershed(soft if soft.ndim > 2 else cv2.merge([soft, soft, soft]), marks)
    return np.asarray(basins == _INSIDE)
