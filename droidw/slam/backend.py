"""Global bundle adjustment over all keyframes (REFERENCE 5.7)."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import torch

from droidw.geometry.transfer import upload
from droidw.graph.factors import FactorGraph
from droidw.graph.proximity import backend_edges, frontend_edges
from droidw.interfaces.correspondence import Upsamples
from droidw.slam.apart import distances_between
from droidw.slam.between import inherited
from droidw.slam.convergence import moved_by
from droidw.slam.doubt import Link, explained_share, weakest_link
from droidw.slam.focal import MIN_KEYFRAMES, FocalSearch, refine_focal
from droidw.slam.motion_filter import spans
from droidw.slam.passes import all_passes
from droidw.slam.path import Path
from droidw.slam.seen_through import moves_ahead, open_though_seen_through
from droidw.solve.weights import closed_share

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.config.schema import DroidwConfig, SolverConfig
    from droidw.interfaces.correspondence import EdgeSession
    from droidw.slam.between import Between
    from droidw.slam.optimise import Optimiser
    from droidw.slam.passes import Kernel, Pass

__all__ = ["Backend"]

_log = logging.getLogger(__name__)


class Backend:
    """Rebuilds a graph over the whole sequence and optimises it.

    Args:
        focal_known: the focal length is a calibration, not a guess.
        motion_prior: how much steady motion counts in the first pass, as `backend.motion_prior`.
        passes: to make; None: those of the configuration.
        fresh: the path was just tracked: `backend.learn` and `backend.seen_through` count.
        between: adds keyframes as `backend.between` says; None: there are no more.
    Attributes:
        passes: those that `run` makes.
        focal: what the search for a better focal length found, None without one.
        agreement: share of what was measured last that agrees with poses and depths; NaN before.
        weakest: where least of that agrees.
    """

    def __init__(
        self,
        optimiser: Optimiser,
        config: DroidwConfig,
        focal_known: bool = True,
        motion_prior: float = 0.0,
        passes: Sequence[Pass] | None = None,
        fresh: bool = False,
        between: Between | None = None,
    ) -> None:
        self.optimiser = optimiser
        self.config = config
        wide = config.global_solver.cauchy > 0
        self.passes = all_passes(config.backend, wide) if passes is None else tuple(passes)
        self.focal_known = focal_known
        self.motion_prior = motion_prior
        self.fresh = fresh
        self._between = between
        self.focal: FocalSearch | None = None
        self.agreement = float("nan")
        self.weakest = Link()

    def run(self, tell: Callable[[int, int], None]) -> int:
        """Make the passes; where much is seen through what seems far away, once more without that.

        Where the path is in doubt in the end, keyframes that came from between others are taken
        out: what measures it in other ways does so by the keyframes that it was tracked with.

        Args:
            tell: called with (update steps done, those in all so far: `more_passes` adds to them).
        Returns:
            The number of edges of the last pass, 0 if there was nothing to do.
        """
        store = self.optimiser.store
        if len(store) < 3:
            return 0
        given = store.intrinsics.clone(), store.image_intrinsics.clone()
        graph = self._make(tell)
        if graph is not None and self.fresh and self._sees_through(graph):
            if self.focal is not None and self.focal.factor != 1.0:
                # What others see through had a say in it. It is looked for again.
                store.intrinsics.copy_(given[0])
                store.image_intrinsics.copy_(given[1])
                self.optimiser.upright.measure()
            if self._between is not None:
                self._between.remove()
            graph = self._make(tell)
        if self._between is not None and graph is not None:
            if self._in_doubt():
                self._between.remove()
            else:
                self._between.remove_loose(graph, self.optimiser.gates())
        return 0 if graph is None else len(graph)

    def _sees_through(self, graph: FactorGraph) -> bool:
        """Whether so much is open though others see through it, which is known from now on."""
        store, options = self.optimiser.store, self.config.backend
        # Where no uncertainty is asked for, nothing is closed. And a path in doubt may have all in
        # the wrong place.
        if options.seen_through >= 1 or not bool(store["uncertainty"].any()):
            return False
        if self._in_doubt():
            return False
        gates = self.optimiser.gates()
        through = moves_ahead(store, graph, gates, options.seen_through)
        if through is None:
            return False
        _log.info(
            "%.0f %% of what is seen seems far away, but where the camera comes to later there is "
            "something nearer: it moves ahead. Adjusting once more without it "
            "(backend.seen_through=1 does not)",
            100 * open_though_seen_through(through, gates),
        )
        store["through"].copy_(through)
        return True

    def _make(self, tell: Callable[[int, int], None]) -> FactorGraph | None:
        """Make the passes, as of `run`; the graph of the last one."""
        options, store = self.config.backend, self.optimiser.store
        row = self.config.schedule["global"]
        total = sum(part.updates for part in self.passes)
        done = 0
        graph = None
        anew = False
        again = options.more_passes if self.fresh else 0
        passes = deque(self.passes)
        while passes:
            part = passes.popleft()
            if part.kernel == "narrowest" and graph is not None:
                self._tend_between(graph)
            before = Path.of(store) if again > 0 and not passes else None
            learns = self.fresh and options.learn and part.learns
            if learns and not anew:
                self.optimiser.begin_anew()
                anew = True
            phase = replace(row, learn=row.learn or learns)
            if options.normalize and not bool(store["prior"].any()):
                mean = store.disps.mean()
                store.disps.div_(mean)
                store.T_cw[:, :3].mul_(mean)
            solver = self._solver(part.kernel)
            graph = FactorGraph(store.grid.height, store.grid.width, store.device)
            more = part.kernel == "narrowest" and self._hidden() >= options.edges_hidden
            graph.add(self.edges(more))
            if len(graph) < 3:
                return None
            session = self.optimiser.parts.correspondence.session("global")
            shown = store.disps
            for _ in range(part.updates):
                if "droid-w" in self.config.compat:
                    # as published: enlarged before the bundle adjustment of the same step
                    shown = store.disps.clone()
                self.optimiser.update(
                    graph,
                    session,
                    phase,
                    solver,
                    first_free=1,
                    motion_prior=part.steady * self.motion_prior,
                )
                done += 1
                tell(done, total)
            if part.refines and self.config.camera.refine_focal and len(store) >= MIN_KEYFRAMES:
                self.focal = refine_focal(
                    self.optimiser,
                    graph,
                    phase,
                    self.config.global_solver,
                    self.config.camera,
                    self.focal_known,
                )
            if passes:
                continue
            gates = self.optimiser.gates()
            self._judge(graph, gates)
            if before is not None and self._moves_on(before, gates):
                again -= 1
                total += part.updates
                passes.append(replace(part, refines=False))
            else:
                self._upsample(session, shown)
        return graph

    def _tend_between(self, graph: FactorGraph) -> None:
        """Add keyframes where much is hidden and the path not in doubt; later, take out loose ones.

        Args:
            graph: of the pass before, with what was measured last.
        """
        options = self.config.backend
        if self._between is None or options.between == 0:
            return
        gates = self.optimiser.gates()
        if self._between.made:
            self._between.remove_loose(graph, gates)
            return
        if closed_share(gates) < options.between_hidden:
            return
        self._judge(graph, gates)
        if not self._in_doubt():
            self._between.add()

    def _moves_on(self, before: Path, gates: Tensor) -> bool:
        """Whether the path had not come to rest before this pass, and is worth another one.

        A path in doubt is not: it is measured in other ways afterwards. Nor is one of which little
        is hidden: more passes do not bring it nearer to the truth.
        """
        options = self.config.backend
        if closed_share(gates) < options.edges_hidden:
            return False
        if self._in_doubt():
            return False
        moved = moved_by(before, self.optimiser.store, gates)
        _log.info(
            "the last pass moved what poses and depths predict by %.4f cells (backend.at_rest=%g)",
            moved,
            options.at_rest,
        )
        return moved > options.at_rest

    def _solver(self, kernel: Kernel) -> SolverConfig:
        """The solver of a pass with this kernel.

        One that follows the median residual is too narrow to mend what has broken off, as long as
        most of the path is sound. So the last passes alone have it. And they alone let depths go
        that say little: under a wide kernel wrong matches would carry them off. Most matches are
        off by something that they share, and where the path has come to rest by all of them, the
        half that fits best knows better: the very last passes go by that. Walls and floors make up
        there for what is hidden; where little is, they know less than matches do.
        """
        solver, options = self.config.global_solver, self.config.backend
        if kernel == "wide":
            return self._wider(options.wide_start)
        if kernel == "usual":
            return replace(solver, cauchy_tuning=0.0, depth_damping=1.0)
        if kernel == "narrowest":
            if options.last_planes > 0 and self._hidden() >= options.planes_hidden:
                solver = replace(solver, planes=options.last_planes)
            if options.last_tuning > 0:
                tuning, slip = options.last_tuning, options.last_slip
                solver = replace(solver, cauchy_tuning=tuning, cauchy_slip=slip)
        return solver

    def _judge(self, graph: FactorGraph, gates: Tensor) -> None:
        """Find out how much agrees of what was measured last, in all and where it is least."""
        measured = self.optimiser.store, graph, graph.select(), gates
        self.agreement = explained_share(*measured)
        self.weakest = weakest_link(*measured)

    def _in_doubt(self) -> bool:
        """Whether so little agreed last that the path is to be measured in other ways."""
        options, doubts = self.config.backend, self.optimiser.upright.doubts
        return doubts(self.agreement, options.restart_below) or self.weakest.broken(
            options.broken_below
        )

    def _hidden(self) -> float:
        """Share of all cells that are closed, by uncertainty or a mask."""
        return closed_share(self.optimiser.gates())

    def _upsample(self, session: EdgeSession, disps: Tensor) -> None:
        """Keep full-size maps where correspondence can make them."""
        if not isinstance(session, Upsamples):
            return
        for node, info in enumerate(self.optimiser.store.infos):
            fine = session.upsample(node, disps[node])
            if fine is not None:
                info.disp_full = fine.float().cpu().numpy()

    def narrowing(self) -> list[SolverConfig]:
        """Solvers for what is far off, one after the other: their kernel narrows."""
        solver, wide = self.config.global_solver, self.config.backend.wide_start
        widths = (wide, wide, wide**0.5) if solver.cauchy > 0 else ()
        return [*map(self._wider, widths), solver]

    def _wider(self, times: float) -> SolverConfig:
        """The solver with a kernel so many times as wide, whatever the residuals."""
        solver = self.config.global_solver
        cauchy = times * solver.cauchy
        return replace(solver, cauchy=cauchy, cauchy_tuning=0.0, depth_damping=1.0)

    def edges(self, more: bool = False) -> list[tuple[int, int]]:
        """Directed edges between keyframes, chosen by how far they are apart now.

        What is hidden in some pairs of pictures is seen in others: where much is, more pairs tell
        more. Before a path has come to rest they hold it where it is. Keyframes from between others
        share the edges of these.

        Args:
            more: as `backend.last_nms` and `backend.last_factors` say.
        """
        store, options = self.optimiser.store, self.config.backend
        nms, factors = options.nms, options.factors_per_keyframe
        if more:
            nms, factors = min(nms, options.last_nms), max(factors, options.last_factors)
        old = list(range(len(store))) if self._between is None else self._between.old()
        distance = distances_between(store, old, options.beta)
        there = upload(torch.tensor(old, dtype=torch.int64), store.device)
        hidden = store["movable"][there], store["unmasked"][there]
        steps = spans(*hidden, self.config.motion_filter)
        # where keyframes are near to one another, more of them are as far apart as elsewhere
        most = int(factors * (1 / steps).sum())
        diamond = options.nms_shape == "diamond"
        propose = partial(frontend_edges, first_i=0, first_j=0, existing=())
        found = (propose if diamond else backend_edges)(
            distance,
            radius=options.radius,
            nms=nms,
            threshold=options.threshold,
            max_factors=most,
            spans=steps,
        )
        return found if len(old) == len(store) else inherited(found, old, len(store))
