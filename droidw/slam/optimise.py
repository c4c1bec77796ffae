"""One update step: correspondence, then bundle adjustment and uncertainty in turns."""

from __future__ import annotations

import math
import operator
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from droidw.geometry.projective import reproject
from droidw.geometry.transfer import on_device
from droidw.interfaces.correspondence import EdgeRequest
from droidw.interfaces.features import KnowsMovable
from droidw.interfaces.uncertainty import Begins, Indices, UncertaintyView
from droidw.slam.contract import energy_of, update_of
from droidw.slam.seen_through import evidence
from droidw.slam.stepping import stepped
from droidw.slam.upright import Upright
from droidw.solve.epipolar import PointMatches, epipolar_term
from droidw.solve.kernel import redescended, usual_square
from droidw.solve.motion import steady_motion
from droidw.solve.problem import BAProblem, PoseTerm, Report
from droidw.solve.weights import gate, half_open, opened, parting, residual_weights

if TYPE_CHECKING:
    from droidw.config.schema import LinesConfig, PhaseConfig, SolverConfig, WeightingConfig
    from droidw.graph.factors import FactorGraph
    from droidw.graph.store import KeyframeStore
    from droidw.interfaces.bundle import BundleAdjuster
    from droidw.interfaces.correspondence import Correspondence, EdgeSession
    from droidw.interfaces.depth import DepthPrior
    from droidw.interfaces.features import FeatureExtractor
    from droidw.interfaces.uncertainty import UncertaintyModel
    from droidw.slam.timing import Stopwatch

__all__ = ["Optimiser", "Parts"]

Pairs = Sequence[tuple[int, int]]


@dataclass(frozen=True)
class Parts:
    """The plugins of a run, built."""

    features: FeatureExtractor
    depth: DepthPrior
    uncertainty: UncertaintyModel
    ba: BundleAdjuster
    correspondence: Correspondence


@dataclass(frozen=True)
class _Edges:
    """Edges between keyframes that are counted from `low`, on the device and on the host."""

    low: int
    ii: Tensor
    jj: Tensor
    pairs: list[tuple[int, int]]


# The gate closes so many times later at most: one of two movers may look more like what stands.
_LATEST = 2.5


class Optimiser:
    """Alternates the parts over a factor graph as a phase of the schedule says.

    Args:
        store: keyframes; poses, disparities and uncertainty are written back to it.
        parts: the plugins.
        weighting: how confidence and uncertainty become weights.
        clock: where the time of each part is added up.
        published: similarities are the raw cosine, whatever `weighting` says.
        lines: how much lines in the pictures count; None: not at all.
    Attributes:
        begins: uncertainty is to be told what can move before the first search. begun: it was.
        anew: it has learned anew, from a path that was mended.
        doubtful: correspondence is asked on behalf of a path that is in doubt.
        points: matched between keyframes of the store, and how much they count in steps that all
            keyframes have a part in: a fifth of a pixel off its epipolar line, a point counts as
            much as so many matches with a usual residual. None: not at all.
        upright: how the keyframes of the store are turned by the lines that they see.
        cost: energy before the last step. usual: square of a usual residual then, where something
            counts besides matches.
    """

    def __init__(
        self,
        store: KeyframeStore,
        parts: Parts,
        weighting: WeightingConfig,
        clock: Stopwatch,
        published: bool = False,
        lines: LinesConfig | None = None,
    ) -> None:
        self.store = store
        self.parts = parts
        self.weighting = weighting
        self.clock = clock
        self._lines = lines
        self.upright = Upright(store, parts.correspondence, lines, self.gates, clock)
        self._published = published
        model, features = parts.uncertainty, parts.features
        calibrated = published or getattr(features, "calibrated", False)
        self._calibrate = weighting.similarity == "matched" and not calibrated
        wanted = isinstance(model, Begins) and model.begins
        self.begins = wanted and isinstance(features, KnowsMovable)
        self.begun = self.anew = self.doubtful = False
        self._later = 1.0
        self.points: tuple[PointMatches, float] | None = None
        self.reports: Counter[str] = Counter()
        self.iterations, self.cost, self.usual = 0, float("nan"), 0.0

    def beside(self, store: KeyframeStore) -> Optimiser:
        """The same for another store, whose uncertainty begins with what this one has learned."""
        other = Optimiser(
            store, self.parts, self.weighting, self.clock, self._published, self._lines
        )
        other.upright.like(self.upright)
        other.begun, other.anew, other._later = self.begun, self.anew, self._later
        other.doubtful = self.doubtful
        return other

    def begin(self) -> None:
        """Let uncertainty start from what features say of the keyframes so far, if it wants to."""
        model = self.parts.uncertainty
        if self.begins and isinstance(model, Begins):
            view = self.view(frames=range(len(self.store)))
            with self.clock("uncertainty"):
                model.begin(view, self.store["movable"])
            self.begun = True

    def begin_anew(self) -> None:
        """Let uncertainty start once more, by all keyframes, where it started with what can move.

        What it learned while the path was off in scale closes what stands still. From here on the
        gate goes by how uncertainty parts: movers stand out from what a right path teaches.
        """
        if self.begun:
            self.begin()
        self.anew = True
        self._part()

    def measure(
        self,
        graph: FactorGraph,
        session: EdgeSession,
        rows: list[int],
        informed: bool,
        learned: bool,
    ) -> None:
        """Ask correspondence about these edges and keep its answer in the graph.

        Args:
            informed, learned: poses and depths, and uncertainty, are good enough to search with.
        """
        if not rows:
            return
        store = self.store
        ii, jj = graph.index(rows)
        with self.clock("reproject"):
            coords, valid = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
        request = EdgeRequest(
            ids=[graph.ids[r] for r in rows],
            ii=[graph.ii[r] for r in rows],
            jj=[graph.jj[r] for r in rows],
            coords=coords,
            valid=valid,
            payload=store.payload,
            informed=informed,
            gates=self.learned_gates if learned and (informed or self.begun) else None,
            doubtful=self.doubtful,
        )
        with self.clock("correspondence"):
            answer = update_of(session.update(request), request)
        graph.record(rows, answer.target, answer.confidence)
        if answer.damping is not None and answer.sources is not None:
            store["damping"][on_device(answer.sources, store.device)] = answer.damping

    def update(
        self,
        graph: FactorGraph,
        session: EdgeSession,
        phase: PhaseConfig,
        solver: SolverConfig,
        *,
        first_free: int,
        reach: int = 3,
        informed: bool = True,
        motion_prior: float = 0.0,
    ) -> None:
        """One update step over the active edges, with retired ones near the window in BA.

        Args:
            graph, session: edges and their correspondence state.
            phase: which parts take turns. solver: damping.
            first_free: poses before this keyframe are held.
            reach: retired edges take part if both ends are at `first_free - reach` or later.
            informed: whether correspondence may search around what geometry predicts.
            motion_prior: how much steady motion counts, as `backend.motion_prior`.
        """
        active = graph.select()
        self.measure(graph, session, active, informed, learned=phase.weigh)
        low = max(0, first_free - reach)
        retired = [r for r in graph.select(active=False) if min(graph.ii[r], graph.jj[r]) >= low]
        self.adjust(graph, sorted(active + retired), phase, solver, first_free, motion_prior)
        graph.grow_older(active)

    def adjust(
        self,
        graph: FactorGraph,
        rows: list[int],
        phase: PhaseConfig,
        solver: SolverConfig,
        first_free: int,
        motion_prior: float = 0.0,
    ) -> None:
        """Gauss-Newton iterations on these edges, each followed by an uncertainty update."""
        if not rows:
            return
        ii, jj = graph.index(rows)
        pairs = [(graph.ii[r], graph.jj[r]) for r in rows]
        low = min(min(pair) for pair in pairs)
        used = _Edges(low, ii - low, jj - low, [(i - low, j - low) for i, j in pairs])
        whole = len(rows) == len(graph)
        at = slice(None) if whole else on_device(rows, graph.target.device)
        target, confidence = graph.target[at], graph.confidence[at]
        for _ in range(phase.iterations):
            with self.clock("bundle"):
                self._step(used, target, confidence, phase, solver, first_free, motion_prior)
            if phase.learn:
                with self.clock("uncertainty"):
                    self._learn(ii, jj, pairs, target, confidence, first_free)

    def _step(
        self,
        edges: _Edges,
        target: Tensor,
        confidence: Tensor,
        phase: PhaseConfig,
        solver: SolverConfig,
        first_free: int,
        motion_prior: float,
    ) -> None:
        """One Gauss-Newton step on the part of the store that the edges touch."""
        store, weighting = self.store, self.weighting
        low = edges.low
        gates = self.gates(low, learned=phase.weigh)
        weight = residual_weights(
            confidence,
            None,
            gates,
            edges.ii,
            edges.jj,
            target,
            bidirectional=weighting.bidirectional,
            scale=weighting.confidence_scale,
        )
        count = len(store) - low
        fixed = torch.arange(count, device=store.device) < first_free - low
        damping = weighting.damping_scale * store["damping"][low:] + weighting.damping_floor
        problem = BAProblem(
            T_cw=store.T_cw[low:],
            disps=store.disps[low:],
            intrinsics=store.intrinsics,
            ii=edges.ii,
            jj=edges.jj,
            target=target,
            weight=weight,
            fixed=fixed,
            damping=solver.depth_damping * damping,
            prior=store["prior"][low:] if phase.depth_prior else None,
            prior_weight=weighting.prior_weight,
            lm=solver.lm,
            ep=solver.ep,
            huber=solver.huber or None,
            guard=solver.guard,
            min_disp=weighting.min_disp,
            max_disp=weighting.max_disp or None,
            pairs=edges.pairs,
        )
        known = self._known(problem, low, motion_prior, settled=solver.cauchy_tuning > 0)
        problem = redescended(replace(problem, pose_term=known), solver)
        problem = self.upright.flat(problem, gates, solver.planes * self.usual)
        step = stepped(self.parts.ba, problem)
        self.note(step.report)
        self.cost = step.report.cost_before
        store.T_cw[low:] = step.T_cw[:count]
        store.disps[low:] = step.disps[:count]

    def _known(self, problem: BAProblem, low: int, steady: float, settled: bool) -> PoseTerm | None:
        """What is known of the poses from `low` on besides matches."""
        points = self.points if low == 0 else None
        if steady <= 0 and points is None and not self.upright.holds:
            return None
        usual = self.usual = usual_square(problem)
        said = [self.upright.term(problem.T_cw, low, usual, settled)]
        if steady > 0:
            times = torch.tensor(self.store.times()[low:], dtype=torch.float64)
            said.append(steady_motion(problem.T_cw, times, steady * usual))
        if points is not None:
            said.append(epipolar_term(problem.T_cw, points[0], points[1] * usual))
        terms = [term for term in said if term is not None]
        return reduce(operator.add, terms) if terms else None

    def note(self, report: Report) -> None:
        """Count a step that was left out, and measurements that were."""
        if report.status != "ok":
            self.reports[report.status] += 1
        if report.dropped:
            self.reports["dropped"] += report.dropped

    def gates(self, first: int = 0, learned: bool = True) -> Tensor:
        """Weights in [0,1] of all cells of the keyframes from `first` on, [N-first,h,w].

        What the user's masks leave, times what uncertainty leaves (if `learned`).
        """
        unmasked = self.store["unmasked"][first:]
        return unmasked * self._gate_at(slice(first, None)) if learned else unmasked

    def learned_gates(self, nodes: Sequence[int]) -> Tensor:
        """What uncertainty alone leaves of these keyframes, [n,h,w] in [0,1]."""
        return self._gate_at(on_device(nodes, self.store.device))

    def _gate_at(self, at: Tensor | slice) -> Tensor:
        return self._gate(self.store["uncertainty"][at], self.store["through"][at])

    def _gate(self, u: Tensor, through: Tensor) -> Tensor:
        w = self.weighting
        share = min(w.open_share, w.open_late) if self.anew else w.open_share
        u = opened(u / self._later + evidence(through), share, w.gate, w.slope, w.shift)
        return gate(u, w.gate, w.slope, w.shift, w.floor, w.closed_below if self.anew else 0.0)

    def _part(self) -> None:
        """Let the gate close where what was learned parts in two, if that is later."""
        w = self.weighting
        if self.anew and w.parted:
            half = half_open(w.gate, w.slope, w.shift)
            self._later = min(max(parting(self.store["uncertainty"]) / half, 1.0), _LATEST)

    def view(
        self,
        ii: Tensor | None = None,
        jj: Tensor | None = None,
        target: Tensor | None = None,
        confidence: Tensor | None = None,
        frames: Sequence[int] = (),
        pairs: Pairs = (),
    ) -> UncertaintyView:
        """What the uncertainty model sees of the store and of these edges, `pairs` on the host."""
        store = self.store
        host = None
        if ii is None or pairs:
            host = Indices([i for i, _ in pairs], [j for _, j in pairs], list(frames))
        none = torch.zeros(0, dtype=torch.int64, device=store.device)
        blank = store.disps.new_zeros(0, store.grid.height, store.grid.width, 2)
        return UncertaintyView(
            features=store["features"],
            uncertainty=store["uncertainty"],
            fields=store.extra(),
            T_cw=store.T_cw,
            disps=store.disps,
            intrinsics=store.intrinsics,
            ii=none if ii is None else ii,
            jj=none if jj is None else jj,
            target=blank if target is None else target,
            confidence=blank if confidence is None else confidence,
            frames=on_device(list(frames), store.device),
            host=host,
            iteration=self.iterations,
            gate=lambda u: self._gate(u, store["through"]),
            calibrate=self._calibrate,
            mended=self.anew and not self.doubtful,
        )

    def _learn(
        self,
        ii: Tensor,
        jj: Tensor,
        pairs: Pairs,
        target: Tensor,
        confidence: Tensor,
        first_free: int,
    ) -> None:
        frames = sorted({i for i, _ in pairs} | set(range(first_free, len(self.store))))
        report = self.parts.uncertainty.update(self.view(ii, jj, target, confidence, frames, pairs))
        self.iterations += 1
        self._part()
        if not math.isfinite(energy_of(report)):
            self.reports["uncertainty"] += 1
