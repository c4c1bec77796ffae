"""Whether footage is tracked a second time, and what is hidden from tracking then.

What moves pulls at the first searches of a run, before uncertainty has learned anything. Where the
result does not hold together, the footage is tracked anew with the pictures of keyframes less what
the first time was found to move.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from droidw.geometry.spread import closed

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid
    from droidw.slam.system import Outcome

__all__ = ["Hidden", "accepted", "to_hide"]

Hidden = Mapping[int, npt.NDArray[np.bool_]]

# Share of its weight below which a pixel is hidden, and share of pixels that is worth the time.
_CLOSED = 0.5
_FEW = 0.02
# How much less than before may agree the second time, with other matches and other gates.
_SLACK = 0.05


def to_hide(outcome: Outcome, grid: Grid, below: float) -> Hidden:
    """What is to be hidden while the footage is tracked again, by index of the frame.

    Args:
        outcome: of the first time.
        below: agreement below which it is doubtful; 1 doubts all.
    Returns:
        [H,W] of each keyframe; nothing where there is no doubt, or hardly anything to hide.
    """
    agreement = outcome.diagnosis.agreement
    # NaN, where nothing was adjusted, is no reason.
    if not (agreement < below or (below == 1.0 and agreement == 1.0)):
        return {}
    found = {}
    for keyframe in outcome.keyframes:
        height, width = keyframe.image.shape[:2]
        size = (width, height)
        mask = closed(keyframe.weight, grid.stride, grid.offset, size, _CLOSED)
        if mask.any():
            found[keyframe.index] = mask
    covered = sum(float(mask.mean()) for mask in found.values())
    return found if covered >= _FEW * len(outcome.keyframes) else {}


def accepted(first: Outcome, second: Outcome) -> bool:
    """Whether what was found the second time is to be kept; it is, unless it agrees much less."""
    return second.diagnosis.agreement >= first.diagnosis.agreement - _SLACK
