"""Initialisation and the sliding window (REFERENCE 5.3, 5.4)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from droidw.geometry.projective import frame_distance
from droidw.geometry.se3 import exp, inv, log, mul
from droidw.geometry.transfer import on_device, upload
from droidw.graph.factors import FactorGraph
from droidw.graph.proximity import frontend_edges, neighbour_edges
from droidw.slam.doubt import explained_share
from droidw.slam.locate import carry_depth, locate
from droidw.slam.motion_filter import spans
from droidw.slam.starts import Trials, mirrored
from droidw.solve.weights import CLOSED

if TYPE_CHECKING:
    from droidw.config.schema import DroidwConfig, PhaseConfig, SolverConfig
    from droidw.slam.optimise import Optimiser

__all__ = ["Frontend"]

# More keyframes than this in a row are never dropped.
_MOST_DROPS = 5
# Share of the first keyframes that must be closed as what can move, for it to count as known.
_KNOWN_MOVERS = 0.02
# Gauss-Newton steps that bring a new keyframe to its predecessor.
_MATCH_STEPS = 4


class Frontend:
    """Keeps poses and depths of the newest keyframes up to date.

    Attributes:
        graph: the edges of the window.
        initialised: whether the first keyframes have been bundle-adjusted together.
    """

    def __init__(self, optimiser: Optimiser, config: DroidwConfig) -> None:
        self.optimiser = optimiser
        self.store = optimiser.store
        self.config = config
        self.options = config.frontend
        grid = self.store.grid
        self.graph = FactorGraph(grid.height, grid.width, self.store.device)
        self.session = optimiser.parts.correspondence.session("window")
        self.initialised = False
        self._drops = 0
        self._solver = config.solver
        # Maps whose mean depth the next keyframe starts from, with `predict: hold`.
        self._recent = 1
        self._published = "droid-w" in config.compat

    def grow(self, forced: bool = False) -> int | None:
        """Deal with the keyframe just appended to the store.

        Args:
            forced: the keyframe was forced by a frame count and may not be dropped.
        Returns:
            The number of the keyframe that was dropped for it, or None.
        """
        if self.initialised:
            return self._window(forced)
        if len(self.store) >= self.options.warmup:
            self.initialise()
        return None

    def initialise(self) -> None:
        """Bundle adjustment of all keyframes so far, from scratch."""
        count = len(self.store)
        schedule, options = self.config.schedule, self.options
        self.graph.add(neighbour_edges(count, 3))
        self.optimiser.begin()
        self.optimiser.upright.begin()
        self._solver = self._first_solver()
        self._updates("init_blind", first_free=1, informed=False)
        if options.starts:
            self._try_mirrored()
        for phase in ("init", "init_again"):
            updates = schedule[phase].updates
            if updates:
                self._propose(0, 0, options.init_beta, nms=2)
                self._updates(phase, first_free=1)
            if phase == "init_again":
                self.graph.grow_older(self.graph.select(), -updates)
            if phase == "init" and options.starts:
                self._try_others()
            self._retire([r for r in self.graph.select() if self.graph.ii[r] < count - 4])
        self._recent = 4
        self._solver = self.config.solver
        self.initialised = True

    def resume(self) -> None:
        """Go on from keyframes whose poses and depths are known, as after `initialise`."""
        self.graph.add(neighbour_edges(len(self.store), 3))
        self._updates("init", first_free=1)
        self._recent = 4
        self.initialised = True

    def release(self) -> None:
        """Drop what correspondence holds of the window; nothing can be grown afterwards."""
        self.session.forget(list(self.graph.ids))

    def _try_mirrored(self) -> None:
        """Leave the mirrored solution if that is where the first keyframes have converged to."""
        store, trials = self.store, self._trials()
        found = store.T_cw.clone(), store.disps.clone()
        weigh = self._phase("init_blind").weigh
        cost = trials.settled_cost(weigh)
        store.write(*mirrored(*found))
        # What uncertainty learned could not be taken back, and the first phase has taught it.
        self._updates("init_blind", first_free=1, informed=False, learn=False)
        if not trials.settled_cost(weigh) < cost:
            store.write(*found)

    def _try_others(self) -> None:
        """Start over from planes, and go on from what fits best, or surrounds the rest.

        Where lines tell how the camera is turned no path broke or went with what moves, and what
        reaches farther over bare walls was no better.
        """
        if self._trials().again():
            self._updates("init", first_free=1)
        kernel, least = self.config.solver, self.options.surrounds
        if kernel.cauchy == 0 or least == 0 or self.optimiser.upright.holds:
            return
        if self._trials().around(kernel.cauchy, least):
            self._solver = replace(kernel, cauchy_slip=0.0)
            self._updates("init", first_free=1)

    def _trials(self) -> Trials:
        return Trials(self.optimiser, self.graph, self.config.schedule, self._solver)

    def _first_solver(self) -> SolverConfig:
        """The solver of initialisation: with its Cauchy kernel where it is known what can move.

        Where that is not known, the kernel would hold on to whatever most of the texture is on,
        which may well be what moves, and give up the rest. Nor can it give up what has slipped
        along a line: poses begin with nothing, and by them everything has.
        """
        solver = self.config.solver
        if solver.cauchy == 0:
            return solver
        closed = self.optimiser.gates(learned=True) < CLOSED
        known = float(closed.float().mean()) > _KNOWN_MOVERS
        return replace(solver, cauchy_slip=0.0) if known else replace(solver, cauchy=0.0)

    def _phase(self, name: str) -> PhaseConfig:
        """A row of the schedule; uncertainty that begins with something weighs from the first."""
        row = self.config.schedule[name]
        return replace(row, weigh=True) if name == "init_blind" and self.optimiser.begun else row

    def _updates(
        self, phase: str, first_free: int, informed: bool = True, learn: bool = True
    ) -> None:
        row = self._phase(phase)
        row = row if learn else replace(row, learn=False)
        for _ in range(row.updates):
            self.optimiser.update(
                self.graph,
                self.session,
                row,
                self._solver,
                first_free=first_free,
                informed=informed,
            )

    def _match_newest(self) -> None:
        """Pose and depth of the newest keyframe from what it shares with its predecessor.

        Later searches start from what geometry predicts, and a fast camera is soon far from
        where its last motion would have brought it.
        """
        store, last = self.store, len(self.store) - 1
        phase = self.config.schedule["fill"]
        found = locate(
            self.optimiser,
            [store.payload(last)],
            store.T_cw[last:].clone(),
            [[last - 1]],
            self.optimiser.gates(learned=phase.weigh),
            updates=1,
            iterations=_MATCH_STEPS,
            solver=self.config.filler_solver,
            label="match",
            known=lambda T_cw, usual: self.optimiser.upright.term(T_cw, last, usual),
        )
        store.T_cw[last:] = found
        store.disps[last] = carry_depth(
            store.disps[last - 1], store.T_cw[last - 1 :], store.intrinsics
        )

    def _window(self, forced: bool) -> int | None:
        options, graph, store = self.options, self.graph, self.store
        count = len(store)
        if options.predict == "match":
            self._match_newest()
        self._recent = 1
        self._retire([r for r in graph.select() if graph.age[r] > options.max_age])
        self._propose(
            count - 5, max(count - options.window, 0), options.beta, nms=options.nms, retire=True
        )
        graph.drop_before(max(0, count - 2 * options.window))
        self._updates("window", self._first_free())
        redundant = None if forced else self._redundant()
        if redundant is not None:
            self._drops += 1
            self._remove(redundant)
            return redundant
        self._drops = 0
        self._updates("window_kept", self._first_free())
        return None

    def _redundant(self) -> int | None:
        """The keyframe that shows nothing that its neighbours do not, or None."""
        count, options = len(self.store), self.options
        if options.redundant == "middle":
            if count < 5:
                return None
            near = self._between(count - 4, count - 2) < 2 * options.keyframe_threshold
            return count - 3 if near else None
        if self._drops >= _MOST_DROPS:
            return None
        hidden = self.store["movable"][count - 1 :], self.store["unmasked"][count - 1 :]
        step = spans(*hidden, self.config.motion_filter)
        limit = options.keyframe_threshold * float(step[0])
        near = self._between(count - 2, count - 1) < limit
        return count - 1 if near and not self._doubtful() else None

    def _doubtful(self) -> bool:
        """Whether too little of what the newest keyframe measured agrees with its pose.

        What such a pose calls near may be far, and dropped keyframes make the next search harder.
        """
        least = self.options.keep_below
        if least == 0:
            return False
        graph, last = self.graph, len(self.store) - 1
        rows = [r for r in graph.select() if last in (graph.ii[r], graph.jj[r])]
        return explained_share(self.store, graph, rows, self.optimiser.gates()) < least

    def _between(self, i: int, j: int) -> float:
        """Frame distance of two keyframes."""
        pair = torch.tensor([i]), torch.tensor([j])
        return float(self._distance(*pair, self.options.beta)[0])

    def _first_free(self) -> int:
        """The oldest source of an active edge stays; everything after it is free."""
        rows = self.graph.select()
        return max(1, min((self.graph.ii[r] for r in rows), default=0) + 1)

    def _remove(self, index: int) -> None:
        self.session.forget(self.graph.remove_keyframe(index))
        self.store.remove(index)

    def _retire(self, rows: list[int]) -> None:
        self.session.forget(self.graph.retire(rows))

    def _distance(self, ii: torch.Tensor, jj: torch.Tensor, beta: float) -> torch.Tensor:
        store = self.store
        ii, jj = upload(ii, store.device), upload(jj, store.device)
        return frame_distance(store.T_cw, store.disps, store.intrinsics, ii, jj, beta)

    def _propose(
        self, first_i: int, first_j: int, beta: float, nms: int, retire: bool = False
    ) -> None:
        """Add the edges that frame distance suggests among the newest keyframes.

        With `retire`, as many of the oldest are retired as are too many then.
        """
        count = len(self.store)
        first_i = max(0, first_i)
        rows = torch.arange(first_i, count)
        cols = torch.arange(first_j, count)
        ii, jj = torch.meshgrid(rows, cols, indexing="ij")
        lower = jj < ii
        distance = np.full(ii.shape, np.inf)
        if bool(lower.any()):
            measured = self._distance(ii[lower], jj[lower], beta)
            distance[lower.numpy()] = measured.double().cpu().numpy()
        edges = frontend_edges(
            distance,
            first_i,
            first_j,
            self.graph.pairs,
            radius=self.options.radius,
            nms=nms,
            threshold=self.options.threshold,
            max_factors=self.options.max_factors,
        )
        if retire and self._published:
            new = len(set(edges) - set(self.graph.pairs))
            if len(self.graph.select()) + new > self.options.max_factors:
                room = self.options.max_factors - new
                self._retire(self.graph.oldest_as_published(room))
        self.graph.add(edges)
        if retire:
            self._retire(self.graph.oldest(self.options.max_factors))

    def guess(self, time: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Pose [7] and disparity [h,w] to start a keyframe at `time` from.

        Before initialisation the identity and a plane; then as `frontend.predict` says.
        """
        store = self.store
        count = len(store)
        identity = on_device([0.0, 0, 0, 0, 0, 0, 1], store.device, store.T_cw.dtype)
        if not self.initialised:
            return identity, store.disps.new_ones(store.grid.height, store.grid.width)
        last = store.T_cw[count - 1]
        if self.options.predict == "hold" or count < 2:
            mean = store.disps[max(0, count - self._recent) :].mean()
            return last.clone(), mean.expand(store.grid.height, store.grid.width).clone()
        if self.options.predict == "damped":
            median = store.disps[max(0, count - 3) :].median()
            plane = median.expand(store.grid.height, store.grid.width).clone()
            return mul(exp(0.5 * log(mul(last, inv(store.T_cw[count - 2])))), last), plane
        times = store.times()
        span = times[-1] - times[-2]
        ahead = min(max((time - times[-1]) / span, 0.0), 2.0) if span > 0 else 0.0
        velocity = log(mul(last, inv(store.T_cw[count - 2])))
        return mul(exp(velocity * ahead), last), store.disps[count - 1].clone()
