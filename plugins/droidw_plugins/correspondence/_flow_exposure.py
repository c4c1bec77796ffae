"""Exposure: what all of a picture has become brighter or darker, which nothing in it did.

A camera that meets a window shortens its exposure, and for a search that holds grey levels against
each other everything has moved then to where it is as bright.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from droidw_plugins.correspondence._flow_information import from_border, sample
from droidw_plugins.correspondence._flow_mask import rounded

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_types import Array, FlowFrame

__all__ = ["as_bright", "brightened"]

# Grey levels that are neither black nor white.
_DARK, _BRIGHT = 8.0, 247.0
# A change of brightness (its logarithm) that is none, and the largest one: beyond it another thing
# is there.
_STEADY, _MOST = 0.005, math.log(2.0)


def brightened(a: FlowFrame, b: FlowFrame, moved: Array | None) -> float:
    """How many times as bright things are in `b` as in `a`.

    It is the median over cells that are neither black nor white, so that it hardly matters where
    some of them are: a wall is as bright a pixel further on. Half a hundredth is no change: to
    divide by it would round every pixel anew, for less than a grey level.

    Args:
        moved: [h,w,2] displacement of the cells, pixels; None: nowhere.
    Returns:
        The factor, in [0.5, 2]; 1 where nothing is known.
    """
    ends = a.centres if moved is None else a.centres + moved
    here, there = sample(a.grey, a.centres), sample(b.grey, ends)
    known = from_border(ends, a.grey.shape) >= 0
    for level in (here, there):
        known &= (level > _DARK) & (level < _BRIGHT)
    if not known.any():
        return 1.0
    change = float(np.median(np.log(there[known] / here[known])))
    return 1.0 if abs(change) < _STEADY else math.exp(min(max(change, -_MOST), _MOST))


def as_bright(grey: npt.NDArray[np.uint8], gain: float) -> npt.NDArray[np.uint8]:
    """The picture [H,W] as it was before all of it became `gain` times as bright."""
    if gain == 1.0:
        return grey
    return rounded(grey * np.float32(1.0 / gain))
