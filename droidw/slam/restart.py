"""Pieces of a path that matched points contradict, set out anew from a steady motion.

A path that has settled in the wrong valley explains what was measured around it as well as the
right one would. Points matched by their descriptors are too few to track a camera by, but they
tell where a path is wrong: there a motion that is steady, and so has hardly anything to fit with,
explains far more of them than the path does. What adjustment makes of such a motion is kept where
points gain more than dense matches lose.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from droidw.geometry.projective import viewing_rays
from droidw.geometry.se3 import chained, inv, mul
from droidw.graph.factors import FactorGraph
from droidw.graph.proximity import neighbour_edges
from droidw.interfaces.correspondence import MatchesPoints
from droidw.slam.backend import Backend
from droidw.slam.path import Path
from droidw.slam.splice import lead
from droidw.solve.epipolar import (
    PointMatches,
    cost_of,
    disagreement,
    led,
    planar_twin,
    steady_fit,
)

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.config.schema import DroidwConfig
    from droidw.slam.optimise import Optimiser

__all__ = ["contradicted", "credit", "matched_points", "set_out"]

# Keyframes so far apart are matched: further apart what is alike on a wall is taken for the same.
_GAP = 2
# Keyframes of a window whose motion is taken for steady, and from one window to the next.
_WINDOW, _APART = 15, 5
# Share of what matches cost on the path that they cost with a steady motion, at most, where the
# path is contradicted, and by how much less for each motion at least; the share of them that must
# lie within a pixel of it, for what moves is matched as well; and how many must span an interval
# that is to change.
_CONTRADICTED, _AT_LEAST = 0.75, 1.0
_MOST, _NEAR_COST = 0.75, cost_of(1.0)
_LEAST = 8
# Rounds in which a plane is fitted to what is seen.
_ROUNDS = 5
# How much of a lead in points a lead in dense matches makes up for. More of these are right or
# wrong together, but what steps aside for points alone must not lose what is seen.
_DENSE = 2.0
# Cost of matches on an interval below which none of it is worth a lead.
_NOTHING = 1.0


def matched_points(optimiser: Optimiser) -> PointMatches | None:
    """Points between near keyframes, but for those on what uncertainty closes.

    Returns:
        None where correspondence matches none.
    """
    operator, store = optimiser.parts.correspondence, optimiser.store
    if not isinstance(operator, MatchesPoints) or len(store) < _WINDOW:
        return None
    gates = optimiser.gates().cpu().numpy()
    found, ends = [], []
    for i, j in neighbour_edges(len(store), _GAP):
        if i > j:
            continue
        points = operator.matched_points(store.payload(i), store.payload(j), gates[i], gates[j])
        found.append(np.asarray(points, np.float64).reshape(-1, 4))
        ends.append(np.tile((i, j), (len(points), 1)))
    at, end = torch.from_numpy(np.concatenate(found)), torch.from_numpy(np.concatenate(ends))
    if not len(at):
        return None
    fx, fy, cx, cy = store.image_intrinsics.double().cpu().tolist()
    scale, centre = torch.tensor([fx, fy]).double(), torch.tensor([cx, cy]).double()
    one = torch.ones(len(at), 1, dtype=torch.float64)
    rays = [torch.cat([(part - centre) / scale, one], dim=1) for part in (at[:, :2], at[:, 2:])]
    return PointMatches(end[:, 0], end[:, 1], rays[0], rays[1], (fx * fy) ** 0.5)


def contradicted(
    path: Path, matches: PointMatches, intrinsics: Tensor, gates: Tensor
) -> dict[int, Tensor]:
    """Motions [7] that explain far more of the matches, by interval between keyframes.

    Looked for from the motions of the path and from their twins before the plane that is nearest to
    what is seen.

    Args:
        intrinsics: [4] of the grid. gates: [N,h,w] in [0,1].
    """
    T = path.T_cw.double().cpu()
    count = len(T)
    known = mul(T[1:], inv(T[:-1]))
    twins = planar_twin(known, _planes(path.disps[:-1], intrinsics, gates[:-1]))
    nearest: dict[int, tuple[float, Tensor]] = {}
    for first in range(0, count - _WINDOW + _APART, _APART):
        last = min(first + _WINDOW, count) - 1
        inside = matches.within(first, last, _GAP)
        if not len(inside):
            continue
        cost = float(disagreement(led(known[first:last]), inside).sum())
        fits = [steady_fit(start[first:last], inside) for start in (known, twins)]
        costs = [disagreement(led(fit), inside) for fit in fits]
        motions, least = min(zip(fits, costs, strict=True), key=lambda pair: float(pair[1].sum()))
        less = cost - float(least.sum())
        if less <= (1 - _CONTRADICTED) * cost or less < _AT_LEAST * len(motions):
            continue
        if float((least < _NEAR_COST).double().mean()) < _MOST:
            continue
        over = inside.spread((inside.jj - inside.ii).double(), last - first + 1)
        for k, motion in enumerate(motions):
            if float(over[k]) < _LEAST:
                continue
            # The middle of a window is known best; nothing lies beyond the ends of a path.
            off = k - (len(motions) - 1) / 2
            ends = (first == 0 and off < 0) or (last == count - 1 and off > 0)
            off = 0.0 if ends else abs(off)
            if first + k not in nearest or off < nearest[first + k][0]:
                nearest[first + k] = off, motion
    return {k: motion for k, (_, motion) in sorted(nearest.items())}


def _planes(disps: Tensor, intrinsics: Tensor, gates: Tensor) -> Tensor:
    """Planes [N,3] (normal over distance) nearest to what is seen, float64.

    Inverse depth is linear in the ray on a plane; what is off counts less in every round.
    """
    d = disps.flatten(1).double().cpu()
    a = viewing_rays(disps.shape[1], disps.shape[2], intrinsics).reshape(-1, 3).double().cpu()
    open_ = gates.flatten(1).double().cpu() + 1e-6
    weight = open_
    plane = torch.zeros(len(d), 3, dtype=d.dtype)
    for _ in range(_ROUNDS):
        H = torch.einsum("nc,ci,cj->nij", weight, a, a)
        plane = torch.linalg.solve(H, torch.einsum("nc,ci,nc->ni", weight, a, d))
        off = (plane @ a.T - d).abs()
        usual = off.median(dim=1, keepdim=True).values.clamp_min(1e-6)
        weight = open_ / (1.0 + (off / usual).square())
    return plane


def set_out(
    optimiser: Optimiser, config: DroidwConfig, path: Path, motions: dict[int, Tensor]
) -> Path:
    """The path with other motions in some intervals, and the depths that go with them.

    Depths follow from what dense matches around the path say: where two motions explain the same
    flow, it is with other depths.

    Args:
        optimiser: of a run; poses, depths and damping of its store become those that are returned.
        motions: [7] from a keyframe to the next, by interval.
    """
    store = optimiser.store
    path.write_to(store)
    backend = Backend(optimiser, config)
    graph = FactorGraph(store.grid.height, store.grid.width, store.device)
    graph.add(backend.edges())
    session = optimiser.parts.correspondence.session("global")
    optimiser.measure(graph, session, graph.select(), informed=True, learned=True)
    changed = path.motions()
    for k, motion in motions.items():
        changed[k] = motion.to(changed)
    replace(path, T_cw=chained(changed, path.T_cw[0])).write_to(store)
    for number in range(len(store)):
        optimiser.upright.turn(number)
    phase = replace(config.schedule["global"], learn=False)
    for solver in backend.narrowing():
        optimiser.adjust(graph, graph.select(), phase, solver, first_free=len(store))
    return Path.of(store)


def credit(
    paths: tuple[Path, Path], supports: tuple[Tensor, Tensor], matches: PointMatches
) -> Tensor:
    """By how much more the second of two paths has for it than the first, [N-1] per interval.

    Args:
        supports: [N-1] of both paths, as of `support`.
    """
    count = len(paths[0].T_cw)
    cost, other = (
        matches.spread(disagreement(path.T_cw.cpu(), matches), count) + _NOTHING for path in paths
    )
    return lead(cost, other) + _DENSE * lead(supports[1], supports[0])
