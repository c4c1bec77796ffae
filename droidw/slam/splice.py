"""Two paths of the same keyframes put together from the pieces in which either agrees more."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from droidw.geometry.se3 import inv, mul
from droidw.graph.factors import FactorGraph
from droidw.graph.proximity import neighbour_edges
from droidw.slam.doubt import Link, explained_weight
from droidw.solve.weights import CLOSED

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.slam.optimise import Optimiser
    from droidw.slam.path import Path

__all__ = ["lead", "pieces", "spliced", "support"]

# Keyframes so far apart are matched to see what agrees between them.
_RADIUS = 3
# What a piece must gain, in leads summed over its intervals: 10 per cent more that agrees over ten
# keyframes, or 50 per cent over two.
_COST = 1.0


def support(optimiser: Optimiser, path: Path) -> Tensor:
    """How much of what is measured between near keyframes agrees with a path, [N-1] float64.

    Per interval between keyframes, as weight of confidence and gate; an edge counts in equal parts
    for all intervals that it spans. Matches are made anew, searched around what the path predicts.

    Args:
        optimiser: of a run; poses, depths and damping of its store become those of the path.
        path: of the keyframes of its store.
    """
    store = optimiser.store
    path.write_to(store)
    graph = FactorGraph(store.grid.height, store.grid.width, store.device)
    graph.add(neighbour_edges(len(store), _RADIUS))
    rows = graph.select()
    session = optimiser.parts.correspondence.session("global")
    optimiser.measure(graph, session, rows, informed=True, learned=True)
    agreeing = explained_weight(store, graph, rows, optimiser.gates())
    between = torch.zeros(len(store) - 1, dtype=torch.float64)
    for row, weight in zip(rows, agreeing.double().cpu(), strict=True):
        low, high = sorted((graph.ii[row], graph.jj[row]))
        between[low:high] += weight / (high - low)
    # Measuring has left the damping of its own matches.
    path.write_to(store)
    return between


def lead(one: Tensor, other: Tensor) -> Tensor:
    """By how much `one` has more support than the other, as a share of the mean; [N-1]."""
    return 2.0 * (one - other) / (one + other).clamp_min(1e-9)


def pieces(ahead: Tensor) -> list[bool]:
    """Intervals in which to leave a path for another one, few and long enough to be worth it.

    Args:
        ahead: [N-1] lead of the other path.
    Returns:
        N-1 times whether the other one is better there: what has the largest sum of leads less
        what pieces cost (Viterbi).
    """
    best = [0.0, float(ahead[0]) - _COST]
    steps: list[tuple[int, int]] = []
    for gain in ahead[1:].tolist():
        came = int(best[1] > best[0]), int(best[1] > best[0] - _COST)
        best = [best[came[0]], best[came[1]] - _COST * (1 - came[1]) + gain]
        steps.append(came)
    side = int(best[1] > best[0])
    chosen = [side]
    for came in reversed(steps):
        side = came[side]
        chosen.append(side)
    return [bool(side) for side in reversed(chosen)]


def spliced(path: Path, other: Path, taken: list[bool], gates: Tensor) -> Path:
    """A path with pieces of another one, each in the scale of what it is joined to.

    Args:
        taken: N-1 times whether the motion from one keyframe to the next is that of the other path.
        gates: [N,h,w] in [0,1]; where open, depths of the keyframe at a joint tell the scale.
    """
    sources = path, other
    side = int(taken[0])
    T_cw, disps = [sources[side].T_cw[0]], [sources[side].disps[0]]
    damping, full = [sources[side].damping[0]], [sources[side].full[0]]
    scale = 1.0
    for node, now in enumerate(taken):
        source = sources[int(now)]
        if int(now) != side:
            side = int(now)
            scale = _scale(source.disps[node], disps[-1], gates[node])
        motion = mul(source.T_cw[node + 1], inv(source.T_cw[node]))
        motion = torch.cat([motion[:3] * scale, motion[3:]])
        T_cw.append(mul(motion, T_cw[-1]))
        disps.append(source.disps[node + 1] / scale)
        damping.append(source.damping[node + 1])
        full.append(source.full[node + 1])
    return replace(
        path,
        T_cw=torch.stack(T_cw),
        disps=torch.stack(disps),
        damping=torch.stack(damping),
        full=tuple(full),
        agreement=float("nan"),
        weakest=Link(),
    )


def _scale(disps: Tensor, to: Tensor, gate: Tensor) -> float:
    """Median ratio of two inverse depths [h,w], where the gate is open if it is anywhere; or 1."""
    known = torch.isfinite(disps) & torch.isfinite(to) & (disps > 0) & (to > 0)
    seen = known & (gate >= CLOSED)
    seen = seen if bool(seen.any()) else known
    return float((disps[seen] / to[seen]).median()) if bool(seen.any()) else 1.0
