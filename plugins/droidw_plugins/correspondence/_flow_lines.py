"""Straight edges of a picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw_plugins.correspondence._flow_types import Array

__all__ = ["line_segments"]

# Pixels that a line is long at least: the direction of a shorter one is hardly known.
_LEAST = 12.0


def line_segments(picture: npt.NDArray[np.uint8]) -> Array:
    """Ends x, y, x, y of straight edges in a picture [H,W], [n,4] pixels.

    By the detector of von Gioi et al. (LSD: A Line Segment Detector, IPOL 2012), as OpenCV has it.
    """
    found: Any = cv2.createLineSegmentDetector(cv2.LSD_REFINE_ADV).detect(picture)[0]
    if found is None:
        return np.zeros((0, 4), np.float32)
    lines = np.asarray(found, np.float32).reshape(-1, 4)
    length = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
    return np.asarray(lines[length >= _LEAST])
