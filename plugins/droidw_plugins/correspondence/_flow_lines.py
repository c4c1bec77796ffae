"""Straight edges of a picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw_plugins.correspondence._flow_information import sample, slopes
from droidw_plugins.correspondence._flow_types import Array

__all__ = ["line_segments"]

# Pixels that a line is long at least: the direction of a shorter one is hardly known.
_LEAST = 12.0
# The detector works at 0.8 times the size, and goes back by dividing: middles of pixels are at
# integers, so that every line it tells is up and left of where it is by this much.
_SCALE = 0.8
_OFF = 0.5 / _SCALE - 0.5
# Where a line is looked at again: so many places along it, but for its ends, and at each so far to
# either side, in pixels.
_PLACES, _INNER = 24, 0.92
_REACH, _APART = 1.5, 0.25
# Slope, as a share of the steepest across a line, that is not its own.
_BESIDE = 0.25
# Pixels from the line at which a place counts by half, rounds of one fit, and fits.
_FAR, _WEIGHED, _FITS = 0.15, 4, 2


def line_segments(picture: npt.NDArray[np.uint8]) -> Array:
    """Ends x, y, x, y of straight edges in a picture [H,W], [n,4] pixels.

    Found by the detector of von Gioi et al. (LSD: A Line Segment Detector, IPOL 2012), as OpenCV
    has it, and then moved to where the picture is steepest across them.
    """
    detector: Any = cv2.createLineSegmentDetector(cv2.LSD_REFINE_ADV, _SCALE)
    found: Any = detector.detect(picture)[0]
    if found is None:
        return np.zeros((0, 4), np.float32)
    lines = np.asarray(found, np.float32).reshape(-1, 4) + np.float32(_OFF)
    length = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
    lines = lines[length >= _LEAST]
    if len(lines):
        slope = slopes(picture)
        for _ in range(_FITS):
            lines = _fitted(lines, *slope)
    return np.asarray(lines, np.float32)


def _fitted(lines: Array, dx: Array, dy: Array) -> Array:
    """The lines [n,4], each through the steepest places across it.

    A detector joins pixels whose slopes point alike, and the rectangle around them is off by a
    tenth of a pixel and more. The steepest place across an edge is known better than that, at every
    step along it; a robust straight line through all of them leaves out what bends away.

    Args:
        dx, dy: derivatives of the picture [H,W].
    """
    ends = lines.reshape(-1, 2, 2)
    way = ends[:, 1] - ends[:, 0]
    along = way / np.linalg.norm(way, axis=1, keepdims=True)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    part = np.linspace(-_INNER / 2, _INNER / 2, _PLACES, dtype=np.float32)
    away, steepness = _steepest(ends.mean(axis=1), way, normal, part, dx, dy)
    middle, slope, known = _straight(part, away, steepness)
    moved = middle[:, None] + slope[:, None] * np.array([-0.5, 0.5], np.float32)
    known &= np.abs(moved).max(axis=1) < _REACH
    moved[~known] = 0.0
    fitted: Array = (ends + moved[..., None] * normal[:, None]).reshape(-1, 4)
    return fitted


def _steepest(
    middles: Array, way: Array, normal: Array, part: Array, dx: Array, dy: Array
) -> tuple[Array, Array]:
    """How far from each line the picture is steepest beside places on it, [n,p] px, and how steep.

    Only slopes with the sign that the line has there count, less what its surroundings have.

    Args:
        middles, way, normal: [n,2] of the lines, the second from end to end.
        part: [p] of the way, where the places are.
    """
    across = np.arange(-_REACH, _REACH + _APART / 2, _APART, dtype=np.float32)
    places = middles[:, None] + part[None, :, None] * way[:, None]
    points = places[:, :, None] + across[None, None, :, None] * normal[:, None, None]
    flat = points.reshape(len(middles), -1, 2)
    seen = [sample(d, flat, outside=0.0) for d in (dx, dy)]
    slope = (seen[0] * normal[:, :1] + seen[1] * normal[:, 1:]).reshape(points.shape[:3])
    near = len(across) // 2
    sign = np.sign(slope[:, :, near - 1 : near + 2].sum(axis=(1, 2)))
    slope = np.maximum(slope * sign[:, None, None], 0.0)
    slope = np.maximum(slope - _BESIDE * slope.max(axis=-1, keepdims=True), 0.0)
    steepness = slope.sum(axis=-1)
    away: Array = (slope * across).sum(axis=-1) / np.maximum(steepness, 1e-6)
    return away, steepness


def _straight(
    part: Array, away: Array, weight: Array
) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Lines `middle + slope * part` through points [n,p] with these weights, robustly.

    Returns:
        middle and slope, [n] each, and whether there was anything to fit.
    """
    share = weight
    for _ in range(_WEIGHED):
        whole = share.sum(axis=1, keepdims=True) + 1e-9
        centre = (share * part).sum(axis=1, keepdims=True) / whole
        mean = (share * away).sum(axis=1, keepdims=True) / whole
        x = part - centre
        slope = (share * x * (away - mean)).sum(axis=1, keepdims=True)
        slope = slope / ((share * x * x).sum(axis=1, keepdims=True) + 1e-9)
        off = away - mean - slope * x
        share = weight / (1.0 + (off / _FAR) ** 2)
    middle = mean - slope * centre
    return middle[:, 0], slope[:, 0], whole[:, 0] > 1e-3
