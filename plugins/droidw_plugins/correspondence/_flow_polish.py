"""Matches of a search at half size, made exact at full size by the method of Lucas and Kanade.

As Bouguet implements it (Pyramidal Implementation of the Lucas Kanade Feature Tracker, 2000; in
OpenCV), on the finest level alone: one small window per cell costs a tenth of a dense search.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw_plugins.correspondence._flow_information import sample

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_types import Array

__all__ = ["SMALLEST", "polished", "polished_through"]

Picture = npt.NDArray[np.uint8]

# Pixels that a match may move by: a search at half size is hardly ever off by more, and a window
# that goes farther has found something else.
_FARTHEST = 1.5
# Steps per window at most, and pixels below which a step ends it.
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.005)
# Smaller eigenvalue, grey levels^2 per pixel^2 in OpenCV's scale, below which a window is flat.
_FLAT = 1e-4
# Smallest window that OpenCV takes.
SMALLEST = 3
# Grey level that stands for no difference from the surroundings.
_MIDDLE = 128


def polished(a: Picture, b: Picture, points: Array, moved: Array, window: int) -> Array:
    """The displacements with those windows moved on that agree better where they now are.

    What is compared is the difference from the mean of the surroundings, so that a camera which
    changes its exposure between both pictures does not move edges.

    Args:
        a, b: [H,W] grey pictures.
        points: [h,w,2] pixels in `a`. moved: [h,w,2] displacement there that was found, pixels.
        window: width in pixels; below 3, the smallest there is: what was found.
    Returns:
        [h,w,2] displacements; as found where a window is flat, leaves the picture or strays.
    """
    if window < SMALLEST:
        return moved
    better, known = _followed(a, b, points, moved, window)
    return np.where(known[..., None], better, moved)


def polished_through(
    a: Picture, seen: Picture, points: Array, moved: Array, expected: Array, window: int
) -> Array:
    """The same where it is known what moves how, with `b` as it looks through that.

    A window moves as one, and what comes nearer grows. Seen through what is expected it does not,
    and what is left of the motion is little.

    Args:
        a: [H,W]. seen: [H,W], `b` seen through `expected`, [H,W,2] pixels.
        points, moved: as of `polished`. window: at least `SMALLEST`.
    Returns:
        [h,w,2] displacements from `a` to `b`; as found before where that leads elsewhere.
    """
    rest, known = _followed(a, seen, points, np.zeros_like(moved), window)
    through = rest + sample(expected, points + rest)
    known &= np.abs(through - moved).max(axis=-1) < _FARTHEST
    return np.where(known[..., None], through, moved)


def _followed(
    a: Picture, b: Picture, points: Array, moved: Array, window: int
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Where windows that set out from `moved` come to rest, [h,w,2], and which did, [h,w]."""
    start = np.ascontiguousarray(points.reshape(-1, 1, 2), dtype=np.float32)
    found = start + moved.reshape(-1, 1, 2)
    there, known, _ = cv2.calcOpticalFlowPyrLK(
        _contrast(a, window),
        _contrast(b, window),
        start,
        found.copy(),  # overwritten
        winSize=(window, window),
        maxLevel=0,
        criteria=_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_FLAT,
    )
    near = np.abs(there - found).max(axis=-1) < _FARTHEST
    rests: Array = (there - start).reshape(moved.shape)
    return rests, ((known > 0) & near).reshape(moved.shape[:-1])


def _contrast(grey: Picture, window: int) -> Picture:
    """The difference of each pixel from the mean of the window around it."""
    mean = cv2.blur(grey, (window, window))
    differs: Any = cv2.addWeighted(grey, 1.0, mean, -1.0, _MIDDLE)
    contrast: Picture = differs
    return contrast
