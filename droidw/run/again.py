"""Whether footage is tracked a second time, and what is hidden from tracking then.

What moves pulls at the first searches of a run, before uncertainty has learned anything. Where the
result does not hold together, the footage is tracked anew with pictures less what the first time
was found to move. And where much was found to move that nobody knows to, what was taken for the
world may be the one thing that does: the footage is tracked anew without the rest.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from droidw.geometry.spread import closed
from droidw.slam.doubt import explained_share, scatter
from droidw.solve.weights import CLOSED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from droidw.config.schema import DroidwConfig, FrontendConfig
    from droidw.slam.records import Outcome
    from droidw.slam.system import SlamSystem

__all__ = ["Again", "Hidden", "again", "second_time"]

_Mask = npt.NDArray[np.bool_]

# Share of pixels that is worth the time.
_FEW = 0.02
# How much less than before may agree the second time, with other matches and other gates.
_SLACK = 0.05
# How many times farther what agrees with another world has to reach, to be taken for it.
_FARTHER = 1.1
# Share of what is seen that has to agree with another world while that is all that is seen.
_FOUNDED = 0.5
# What can move by so much, as the classifier says, is known to.
_KNOWN = 0.1


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


@dataclass(frozen=True)
class Again:
    """Why footage is tracked a second time, and without what.

    Attributes:
        hidden: of the pictures, while they are tracked.
        turned: that is what was taken for the world; else what was found to move.
        why: a sentence for the log.
    """

    hidden: Hidden
    turned: bool
    why: str

    def unfounded(self, second: SlamSystem) -> str:
        """Why it is not worth the time to finish what has been tracked; "" if it is.

        What does not hold together while it is all that is seen is no world.

        Args:
            second: has tracked all frames, with pictures less what is hidden.
        """
        if not self.turned:
            return ""
        store, graph, gates = second.store, second.frontend.graph, second.optimiser.gates()
        agreement = explained_share(store, graph, list(range(len(graph))), gates)
        seen = (store["unmasked"] >= CLOSED).float().sum()
        share = agreement * float((gates >= CLOSED).float().sum() / seen.clamp_min(1))
        if share >= _FOUNDED:
            return ""
        return f"{100 * share:.0f} % of what was seen while tracking agrees"

    def rejection(self, first: Outcome, second: Outcome) -> str:
        """Why what was found the second time is not to be kept; "" if it is."""
        frames, before = len(second.trajectory), len(first.trajectory)
        if frames < before:
            return f"only {frames} of {before} frames could be read again"
        if self.turned:
            reach, other = _reach(first), _reach(second)
            if not other >= _FARTHER * reach:
                return f"it reaches over {other:.2f} of the picture, and the first over {reach:.2f}"
            return ""
        agreement = second.diagnosis.agreement
        if not agreement >= first.diagnosis.agreement - _SLACK:
            return f"{100 * agreement:.0f} % of what was measured agrees the second time"
        return ""


def again(system: SlamSystem, outcome: Outcome, options: FrontendConfig) -> Again | None:
    """Whether the footage is to be tracked again.

    Args:
        system, outcome: of the first time.
        options: `again_below`, in doubt, and `unknown_moves`.
    Returns:
        What to hide is where uncertainty leaves less than half, or where it leaves more. None
        without a reason, of a camera at rest, or where hardly anything is to be hidden. The user's
        masks are not in it: they hold anyway.
    """
    store, agreement = system.store, outcome.diagnosis.agreement
    doubt = system.optimiser.upright.doubts(agreement, options.again_below)
    if not doubt and (outcome.diagnosis.still or options.unknown_moves >= 1):
        return None
    gates = system.optimiser.learned_gates(range(len(store))).float()
    if doubt:
        turned, weights = False, gates
        why = (
            f"{100 * agreement:.0f} % of what was measured agrees with poses and depths: tracking "
            "once more, without what was found to move (frontend.again_below=0 does not)"
        )
    else:
        shut = gates < CLOSED
        unknown = float((shut & (store["movable"] < _KNOWN)).float().mean())
        if not unknown > options.unknown_moves:
            return None
        turned, weights = True, shut.float()
        why = (
            f"{100 * unknown:.0f} % of the pictures was found to move though nobody knows it to, "
            "and may be what stands still: tracking once more, without the rest "
            "(frontend.unknown_moves=1 does not)"
        )
    grid, size = system.grid, (system.camera.width, system.camera.height)
    hidden = Hidden(
        [info.index for info in store.infos],
        [
            closed(weight, grid.stride, grid.offset, size, CLOSED)
            for weight in weights.cpu().numpy()
        ],
    )
    return Again(hidden, turned, why) if hidden.share >= _FEW else None


def _reach(outcome: Outcome) -> float:
    """Share of the pictures that is open and agrees, times the area that it scatters over.

    What a camera moves against surrounds what moves by itself. The area is in units of that of a
    whole picture, and above 1 where what is closed lies in the middle.
    """
    open_ = torch.stack([torch.from_numpy(k.weight >= CLOSED) for k in outcome.keyframes]).double()
    where = open_.mean(0)
    share = outcome.diagnosis.agreement * float(where.mean())
    return share * scatter(where) / scatter(torch.ones_like(where))


def second_time(config: DroidwConfig) -> DroidwConfig:
    """The configuration of the second time, which is the last."""
    frontend = replace(config.frontend, again_below=0.0, unknown_moves=1.0)
    return replace(config, frontend=frontend)
