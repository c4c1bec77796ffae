"""Where bundle adjustment of the first keyframes can be started from.

Nothing is known of them, and Gauss-Newton ends in the nearest valley. A camera that moves sideways
looks much like one that turns, a scene seen from afar much like the same turned inside out; so
several starts are tried, and the one that explains the measurements best is kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from droidw.geometry.se3 import exp, mul
from droidw.slam.doubt import explained_reach

if TYPE_CHECKING:
    from droidw.config.schema import PhaseConfig, SolverConfig
    from droidw.graph.factors import FactorGraph
    from droidw.slam.optimise import Optimiser

__all__ = ["Trials", "mirrored", "plane_starts"]

# Gauss-Newton steps of a start, and the share of the energy that it must beat.
_STEPS = 15
_BETTER = 0.98
# How much a steady motion counts while a start sets out, as `backend.motion_prior`; widths of the
# kernel by which it then narrows down to what it holds on to, times the last of them, and how much
# a steady motion counts with each; and steps with each.
_STEADY = 100.0
_NARROWING = (8.0, 100.0), (4.0, 33.0), (1.0, 0.0)
_NARROWING_STEPS = 10
# Step between keyframes in plane depths: a hint of a direction, not a guess of a length.
_HINT = 0.02


def mirrored(T_cw: Tensor, disps: Tensor) -> tuple[Tensor, Tensor]:
    """The scene with its depth turned inside out, and the camera moving the other way.

    The turn makes the middle of the picture move as before. Seen from afar, this explains the
    flow almost as well.

    Args:
        T_cw: [N,7]. disps: [N,h,w].
    Returns:
        Poses and disparities of the same shapes.
    """
    mean = disps.mean(dim=(1, 2), keepdim=True)
    t = T_cw[:, :3]
    turn = torch.zeros_like(T_cw[:, :6])
    middle = mean[:, 0, 0].mean()
    turn[:, 3] = -2.0 * middle * t[:, 1]
    turn[:, 4] = 2.0 * middle * t[:, 0]
    poses = mul(exp(turn), T_cw)
    poses[:, :3] = -t * t.new_tensor([1.0, 1.0, 0.0])
    return poses, (2.0 * mean - disps).clamp_min(0.1 * mean)


def plane_starts(disps: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """A plane before a camera that rests, then one that drifts along each axis, either way.

    Args:
        disps: [N,h,w], for shape and device.
    Yields:
        Poses [N,7] and disparities [N,h,w] of ones.
    """
    count = len(disps)
    steps = torch.arange(count, dtype=disps.dtype, device=disps.device)[:, None] * _HINT
    axes = torch.eye(3, dtype=disps.dtype, device=disps.device)
    for way in (torch.zeros_like(axes[0]), *axes, *(-axes)):
        T_cw = disps.new_zeros(count, 7)
        T_cw[:, :3] = steps * way
        T_cw[:, 6] = 1.0
        yield T_cw, torch.ones_like(disps)


@dataclass(frozen=True)
class Trials:
    """Starts of the first keyframes, compared by what bundle adjustment makes of them.

    Attributes:
        optimiser: of a store that holds these keyframes and no others.
        graph: its edges, measured.
        schedule: phases by name. solver: of initialisation.
    """

    optimiser: Optimiser
    graph: FactorGraph
    schedule: Mapping[str, PhaseConfig]
    solver: SolverConfig

    def again(self) -> bool:
        """Start over from planes, now that uncertainty has its say, and keep what fits best.

        What moves by itself has pulled at the first solution, while nothing was known of it.

        Returns:
            Whether anything fits better than what the store held.
        """
        store = self.optimiser.store
        best = store.T_cw.clone(), store.disps.clone()
        cost = _BETTER * self.settled_cost(weigh=True)
        better = False
        for start in plane_starts(store.disps):
            self._set_out(start, self.solver)
            found = self.settled_cost(weigh=True)
            if found < cost:
                cost, better = found, True
                best = store.T_cw.clone(), store.disps.clone()
        store.write(*best)
        return better

    def around(self, kernel: float, least: float) -> bool:
        """Start over with a kernel that narrows, and keep what reaches farthest, if by far.

        Something large that moves, before the camera or ahead of it on a road, can have as many
        matches as the world around it, and no kernel tells which of both stands still. And by a
        narrow kernel alone a path can break in two pieces of different scale, each of which agrees.
        Each start begins with a motion that is steady, and narrows down to what it holds on to;
        what the store held does so at once, and as the others do.

        Args:
            kernel: last width of the Cauchy kernel, cells.
            least: how many times farther than what the store held, see `explained_reach`.
        Returns:
            Whether anything does.
        """
        store = self.optimiser.store
        found = best = store.T_cw.clone(), store.disps.clone()
        farthest, better = least * self._reach(kernel, _NARROWING[-1:]), False
        for number, start in enumerate((found, *plane_starts(store.disps))):
            if number == 0:
                store.write(*start)
            else:
                self._set_out(start, replace(self.solver, cauchy=0.0), _STEADY)
            reach = self._reach(kernel, _NARROWING)
            if reach > farthest:
                farthest, better = reach, True
                best = store.T_cw.clone(), store.disps.clone()
            if number == 0:  # others have to reach farther than what was found does either way
                farthest = max(farthest, least * reach)
        store.write(*best)
        return better

    def settled_cost(self, weigh: bool) -> float:
        """Energy of all edges at the present poses and depths, with uncertainty or without.

        By a Cauchy kernel of the solver, what is far off hardly counts: the less of the energy, the
        more of what was measured agrees.
        """
        store = self.optimiser.store
        before = store.T_cw.clone(), store.disps.clone()
        row = self.schedule["init_blind"]
        self._adjust(replace(row, iterations=1, learn=False, weigh=weigh), self.solver)
        store.write(*before)
        return self.optimiser.cost

    def _set_out(
        self, start: tuple[Tensor, Tensor], solver: SolverConfig, steady: float = 0.0
    ) -> None:
        """Adjust from poses [N,7] and disparities [N,h,w], upright where that is known."""
        store = self.optimiser.store
        store.write(*start)
        for number in range(1, len(store)):
            self.optimiser.upright.turn(number, still=True)
        phase = replace(self.schedule["init"], iterations=_STEPS, learn=False)
        self._adjust(phase, solver, steady)

    def _reach(self, kernel: float, narrowing: Sequence[tuple[float, float]]) -> float:
        """How far what agrees reaches, once narrower kernels have given up the rest.

        Args:
            narrowing: widths of the kernel in lengths of `kernel`, and how much a steady motion
                counts with each.
        """
        phase = replace(self.schedule["init"], iterations=_NARROWING_STEPS, learn=False)
        for wider, steady in narrowing:
            solver = replace(self.solver, cauchy=wider * kernel, cauchy_slip=0.0)
            self._adjust(phase, solver, steady)
        store = self.optimiser.store
        return explained_reach(store, self.graph, self.graph.select(), self.optimiser.gates())

    def _adjust(self, phase: PhaseConfig, solver: SolverConfig, steady: float = 0.0) -> None:
        rows = list(range(len(self.graph)))
        self.optimiser.adjust(self.graph, rows, phase, solver, first_free=1, motion_prior=steady)
