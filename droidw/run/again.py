"""Whether footage is tracked a second time, and what is hidden from tracking then.

What moves pulls at the first searches of a run, before uncertainty has learned anything. Where the
result does not hold together, the footage is tracked anew with pictures less what the first time
was found to move.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from droidw.geometry.spread import closed
from droidw.solve.weights import CLOSED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from droidw.config.schema import DroidwConfig
    from droidw.slam.records import Outcome
    from droidw.slam.system import SlamSystem

__all__ = ["Hidden", "rejection", "second_time", "to_hide"]

_Mask = npt.NDArray[np.bool_]

# Share of pixels that is worth the time.
_FEW = 0.02
# How much less than before may agree the second time, with other matches and other gates.
_SLACK = 0.05


class Hidden:
    """What is hidden of each picture: of one between two keyframes, what is of either.

    Args:
        indices: of the frames of keyframes, ascending.
        masks: [H,W] of each.
    """

    def __init__(self, indices: Sequence[int], masks: Sequence[_Mask]) -> None:
        self._indices = list(indices)
        self._masks = list(masks)

    @property
    def share(self) -> float:
        """Mean share of the pictures of keyframes that is hidden."""
        return float(np.mean([mask.mean() for mask in self._masks])) if self._masks else 0.0

    def __call__(self, index: int) -> _Mask | None:
        """The mask [H,W] of the frame with this index; None where nothing is hidden of it."""
        # The same for a keyframe; the last keyframe for what comes after it.
        last = len(self._indices) - 1
        before = max(bisect_right(self._indices, index) - 1, 0)
        after = min(bisect_left(self._indices, index), last)
        mask = self._masks[before]
        if after != before:
            mask = mask | self._masks[after]
        return mask if mask.any() else None


def to_hide(system: SlamSystem, outcome: Outcome, below: float) -> Hidden | None:
    """What is to be hidden while the footage is tracked again.

    Args:
        system, outcome: of the first time.
        below: agreement below which it is doubtful; 1 doubts all.
    Returns:
        Where uncertainty leaves less than half; None where there is no doubt, or hardly anything
        to hide. The user's masks are not in it: they hold anyway.
    """
    if not system.optimiser.upright.doubts(outcome.diagnosis.agreement, below):
        return None
    store, grid = system.store, system.grid
    size = (system.camera.width, system.camera.height)
    gates = system.optimiser.learned_gates(range(len(store))).float().cpu().numpy()
    hidden = Hidden(
        [info.index for info in store.infos],
        [closed(gate, grid.stride, grid.offset, size, CLOSED) for gate in gates],
    )
    return hidden if hidden.share >= _FEW else None


def second_time(config: DroidwConfig) -> DroidwConfig:
    """The configuration of the second time, which is the last."""
    return replace(config, frontend=replace(config.frontend, again_below=0.0))


def rejection(first: Outcome, second: Outcome) -> str:
    """Why what was found the second time is not to be kept; "" if it is."""
    frames, before = len(second.trajectory), len(first.trajectory)
    if frames < before:
        return f"only {frames} of {before} frames could be read again"
    agreement = second.diagnosis.agreement
    if not agreement >= first.diagnosis.agreement - _SLACK:
        return f"{100 * agreement:.0f} % of what was measured agrees the second time"
    return ""
