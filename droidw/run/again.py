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
    from droidw.slam.system import Outcome, SlamSystem

__all__ = ["Hidden", "accepted", "to_hide"]

Hidden = Mapping[int, npt.NDArray[np.bool_]]

# Share of its weight below which a pixel is hidden, and share of pixels that is worth the time.
_CLOSED = 0.5
_FEW = 0.02
# How much less than before may agree the second time, with other matches and other gates.
_SLACK = 0.05


def to_hide(system: SlamSystem, outcome: Outcome, below: float) -> Hidden:
    """What is to be hidden while the footage is tracked again, by index of the frame.

    Args:
        system, outcome: of the first time.
        below: agreement below which it is doubtful; 1 doubts all.
    Returns:
        [H,W] of keyframes, where uncertainty leaves less than half; nothing where there is no
        doubt, or hardly anything to hide. The user's masks are not in it: they hold anyway.
    """
    agreement = outcome.diagnosis.agreement
    # NaN, where nothing was adjusted, is no reason.
    if not (agreement < below or (below == 1.0 and agreement == 1.0)):
        return {}
    store, grid = system.store, system.grid
    size = (system.camera.width, system.camera.height)
    gates = system.optimiser.learned_gates(range(len(store))).float().cpu().numpy()
    found = {}
    for info, gate in zip(store.infos, gates, strict=True):
        mask = closed(gate, grid.stride, grid.offset, size, _CLOSED)
        if mask.any():
            found[info.index] = mask
    covered = sum(float(mask.mean()) for mask in found.values())
    return found if covered >= _FEW * len(store) else {}


def accepted(first: Outcome, second: Outcome) -> bool:
    """Whether what was found the second time is to be kept; it is, unless it agrees much less."""
    return second.diagnosis.agreement >= first.diagnosis.agreement - _SLACK
