"""Values of the grid at the pixels of the picture."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

__all__ = ["closed", "spread"]


def spread(
    values: npt.NDArray[np.float32], stride: int, offset: float, size: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """Values [h,w] of the grid at every pixel of a picture of `size` (width, height), bilinear."""
    # Pixel (x, y) of the picture is taken from the grid at (x - offset) / stride.
    to_grid = np.array([[1 / stride, 0, -offset / stride], [0, 1 / stride, -offset / stride]])
    found = cv2.warpAffine(
        values, to_grid, size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(found, dtype=np.float32)


def closed(
    weight: npt.NDArray[np.float32],
    stride: int,
    offset: float,
    size: tuple[int, int],
    below: float,
) -> npt.NDArray[np.bool_]:
    """Pixels [H,W] that keep less than `below` of their weight, of weights [h,w] on the grid.

    A cell without a weight (NaN) keeps all of it: it is not called moving.
    """
    known = np.nan_to_num(weight, nan=1.0).astype(np.float32)
    return np.asarray(spread(known, stride, offset, size) < below)
