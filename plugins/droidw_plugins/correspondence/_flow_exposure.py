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

_Numbers = npt.NDArray[np.float64]

# Grey levels that are neither black nor white.
_DARK, _BRIGHT = 8.0, 247.0
# A change of brightness (its logarithm) that is none, and the largest one: beyond it another thing
# is there.
_STEADY, _MOST = 0.005, math.log(2.0)
# What is as bright as a change says it would be lies within this share of the spread of all
# changes, and within these bounds; where nearly as many do without a change, there was none.
_WIDTH, _NARROWEST, _WIDEST = 0.6, 0.02, 0.1
_AS_MUCH = 0.9
_ROUNDS = 10


def brightened(a: FlowFrame, b: FlowFrame, moved: Array | None) -> float:
    """How many times as bright things are in `b` as in `a`.

    It is where the changes of most cells meet that are neither black nor white: what stands still
    and was found again changes alike, and what covers a third of the picture, or is another thing
    there, in all sorts of ways. Where hardly less meets at no change, there was none. Nor is half a
    hundredth one: to divide by it would round every pixel anew, for less than a grey level.

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
    change = _meeting(np.log(there[known] / here[known]).astype(np.float64))
    return 1.0 if abs(change) < _STEADY else math.exp(min(max(change, -_MOST), _MOST))


def _meeting(changes: _Numbers) -> float:
    """Where most of `changes` [n] meet, 0 if nearly as many do there.

    Tukey's biweight, from no change, the median, and the fullest of the bins.
    """
    median = np.median(changes)
    spread = 1.4826 * float(np.median(np.abs(changes - median)))
    width = min(max(_WIDTH * spread, _NARROWEST), _WIDEST)
    filled, edges = np.histogram(changes, np.arange(-_MOST, _MOST + width, width))
    fullest = edges[np.argmax(filled)] + 0.5 * width
    at = np.array([0.0, median, fullest])
    for _ in range(_ROUNDS):
        weights = np.square(_near(changes, at, width))
        at = (weights @ changes) / np.maximum(weights.sum(axis=1), np.finfo(np.float64).tiny)
    met = (_near(changes, np.append(at, 0.0), width) ** 3).sum(axis=1)
    best = int(np.argmax(met[:-1]))
    return 0.0 if met[-1] >= _AS_MUCH * met[best] else float(at[best])


def _near(changes: _Numbers, at: _Numbers, width: float) -> _Numbers:
    """How near each change is to each place, [k,n]: 1 there, 0 from `width` on."""
    return np.maximum(1.0 - np.square((changes - at[:, None]) / width), 0.0)


def as_bright(grey: npt.NDArray[np.uint8], gain: float) -> npt.NDArray[np.uint8]:
    """The picture [H,W] as it was before all of it became `gain` times as bright."""
    if gain == 1.0:
        return grey
    return rounded(grey * np.float32(1.0 / gain))
