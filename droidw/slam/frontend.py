"""Initialisation and the sliding window (REFERENCE 5.3, 5.4)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from droidw.geometry.projective import frame_distance
from droidw.geometry.se3 import exp, inv, log, mul
from droidw.graph.factors import FactorGraph
from droidw.graph.proximity import frontend_edges, neighbour_edges

if TYPE_CHECKING:
    from droidw.config.schema import DroidwConfig
    from droidw.slam.optimise import Optimiser

__all__ = ["Frontend"]

# More keyframes than this in a row are never dropped.
_MOST_DROPS = 5


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

    def grow(self, forced: bool = False, last: bool = False) -> bool:
        """Deal with the keyframe just appended to the store.

        Args:
            forced: the keyframe was forced by a frame count and may not be dropped.
            last: no further frame follows, so that initialisation cannot wait.
        Returns:
            Whether the keyframe was dropped again.
        """
        if self.initialised:
            return self._window(forced)
        if len(self.store) >= self.options.warmup or (last and len(self.store) >= 2):
            self.initialise()
        return False

    def initialise(self) -> None:
        """Bundle adjustment of all keyframes so far, from scratch."""
        count = len(self.store)
        schedule, options = self.config.schedule, self.options
        self.graph.add(neighbour_edges(count, 3))
        self._updates("init_blind", first_free=1, informed=False)
        self._try_reversed()
        for phase in ("init", "init_again"):
            if schedule[phase].updates:
                self._propose(0, 0, options.init_beta, nms=2)
                self._updates(phase, first_free=1)
        self._retire([r for r in self.graph.select() if self.graph.ii[r] < count - 4])
        self.initialised = True

    def _try_reversed(self) -> None:
        """Leave the mirrored solution if that is where the first keyframes have converged to.

        Seen from afar, a scene with its depth turned inside out and the camera moving the other
        way, turned so that the middle of the picture moves alike, explains the flow almost as
        well, and Gauss-Newton cannot cross from one to the other. Both are tried, and the one of
        lower energy stays.
        """
        store = self.store
        found = store.T_cw.clone(), store.disps.clone()
        cost = self._settled_cost()
        mean = store.disps.mean(dim=(1, 2), keepdim=True)
        t = store.T_cw[:, :3]
        turn = torch.zeros_like(store.T_cw[:, :6])
        middle = mean[:, 0, 0].mean()
        turn[:, 3] = -2.0 * middle * t[:, 1]
        turn[:, 4] = 2.0 * middle * t[:, 0]
        mirrored = mul(exp(turn), store.T_cw)
        mirrored[:, :3] = -t * t.new_tensor([1.0, 1.0, 0.0])
        store.write(mirrored, (2.0 * mean - store.disps).clamp_min(0.1 * mean))
        self._updates("init_blind", first_free=1, informed=False)
        if not self._settled_cost() < cost:
            store.write(*found)

    def _settled_cost(self) -> float:
        """Energy at the present poses and depths, without the say of uncertainty."""
        before = self.store.T_cw.clone(), self.store.disps.clone()
        phase = replace(self.config.schedule["init_blind"], iterations=1, learn=False, weigh=False)
        rows = self.graph.select()
        self.optimiser.adjust(self.graph, rows, phase, self.config.solver, first_free=1)
        self.store.write(*before)
        return self.optimiser.cost

    def _updates(self, phase: str, first_free: int, informed: bool = True) -> None:
        row = self.config.schedule[phase]
        for _ in range(row.updates):
            self.optimiser.update(
                self.graph,
                self.session,
                row,
                self.config.solver,
                first_free=first_free,
                informed=informed,
            )

    def _window(self, forced: bool) -> bool:
        options, graph, store = self.options, self.graph, self.store
        count = len(store)
        self._retire([r for r in graph.select() if graph.age[r] > options.max_age])
        self._propose(count - 5, max(count - options.window, 0), options.beta, nms=options.nms)
        self._retire(graph.oldest(options.max_factors))
        graph.drop_before(max(0, count - 2 * options.window))
        self._updates("window", self._first_free())
        if not forced and self._drops < _MOST_DROPS and self._near():
            self._drops += 1
            self._remove(count - 1)
            return True
        self._drops = 0
        self._updates("window_kept", self._first_free())
        return False

    def _near(self) -> bool:
        """Whether the newest keyframe shows nothing that its predecessor does not."""
        count = len(self.store)
        pair = torch.tensor([count - 2]), torch.tensor([count - 1])
        moved = self._distance(*pair, self.options.beta)
        return bool(moved[0] < self.options.keyframe_threshold)

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
        device = store.device
        return frame_distance(
            store.T_cw, store.disps, store.intrinsics, ii.to(device), jj.to(device), beta
        )

    def _propose(self, first_i: int, first_j: int, beta: float, nms: int) -> None:
        """Add the edges that frame distance suggests among the newest keyframes."""
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
        self.graph.add(edges)

    def guess(self, time: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Pose [7] and disparity [h,w] to start a keyframe at `time` from.

        Before initialisation the identity and a plane; then as `frontend.predict` says.
        """
        store = self.store
        count = len(store)
        identity = store.T_cw.new_tensor([0.0, 0, 0, 0, 0, 0, 1])
        if not self.initialised:
            return identity, store.disps.new_ones(store.grid.height, store.grid.width)
        last = store.T_cw[count - 1]
        if self.options.predict == "hold" or count < 2:
            plane = store.disps[count - 1].mean().expand(store.grid.height, store.grid.width)
            return last.clone(), plane.clone()
        times = store.times()
        span = times[-1] - times[-2]
        ahead = min(max((time - times[-1]) / span, 0.0), 2.0) if span > 0 else 0.0
        velocity = log(mul(last, inv(store.T_cw[count - 2])))
        return mul(exp(velocity * ahead), last), store.disps[count - 1].clone()
