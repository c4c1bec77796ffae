"""One Gauss-Newton step in torch: order, linearise, reduce, solve, substitute, guard."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from droidw.geometry import se3
from droidw.solve.problem import BAProblem, Report, Step
from droidw_plugins.bundle._layout import Layout, Workspace, make_layout
from droidw_plugins.bundle._linearise import EdgeSums, edge_motions, energy, linearise
from droidw_plugins.bundle._schur import back_substitute, reduce_system, solve_reduced

__all__ = ["gauss_newton_step"]

# Least undamped pivot, relative to its diagonal entry, that is taken for information and not for
# the rounding of the sums: a free gauge leaves up to 6e-6 in float32 and 2e-14 in float64.
_PIVOT_FLOOR = {torch.float32: 1e-5, torch.float64: 1e-11}


@torch.no_grad()
def gauss_newton_step(problem: BAProblem, work: Workspace, chunk: int, halvings: int) -> Step:
    """The step of `TorchBundleAdjuster`; see there and REFERENCE 3.2, 3.3.

    Args:
        problem: floating tensors of one dtype.
        work: scratch space of the caller.
        chunk: cells worked on at a time.
        halvings: with `problem.guard`, how often a step that raised the energy is halved.
    """
    layout = make_layout(problem.ii, problem.jj)
    T64 = problem.T_cw.double()
    motions = edge_motions(problem.T_cw, layout)
    # the sums hold the energy at the start, but neither a robust one nor one to compare with
    separate = problem.guard or problem.huber is not None
    sums = linearise(problem, layout, motions, work, chunk, separate)
    dropped = 0
    if not bool(torch.isfinite(sums.gram).all()):
        problem, dropped = _without_nonfinite(problem)
        sums = linearise(problem, layout, motions, work, chunk, separate)
        if not bool(torch.isfinite(sums.gram).all()):
            return _unchanged(problem, Report("nonfinite", math.nan, dropped=dropped))

    free, isolated = _free_poses(problem, layout, sums)
    before = _prior_energy(problem, problem.disps)
    if sums.valid is not None:
        before += energy(problem, layout, problem.T_cw, problem.disps, sums.valid, work, chunk)
    else:
        before += float(sums.gram[:, 7, 7].sum())
    report = Report("ok", before, dropped=dropped, isolated=isolated)
    if free.numel() == 0 and not _depth_can_move(problem, sums):
        return _unchanged(problem, replace(report, status="empty"))

    n_free = free.shape[0]
    slots = torch.full_like(problem.fixed, n_free, dtype=torch.int64)
    slots[free] = torch.arange(n_free, device=free.device)
    adjoints = motions.adjoints()
    S, g, depth = reduce_system(problem, layout, sums, adjoints, slots, n_free, work)
    dx = torch.zeros(problem.T_cw.shape[0], 6, dtype=torch.float64, device=S.device)
    if n_free:
        floor = _PIVOT_FLOOR.get(problem.disps.dtype, 1e-5)
        solution = solve_reduced(S, g, problem.lm, problem.ep, floor)
        if solution is None:
            return _unchanged(problem, replace(report, status="singular"))
        dx[free] = solution
    dz = torch.zeros_like(problem.disps)
    if depth is not None:
        _towards_prior(problem, dz)
        moved = back_substitute(layout, sums, depth, adjoints, dx)
        dz[layout.sources] = moved.view(-1, *dz.shape[1:])
    if not (bool(torch.isfinite(dx).all()) and bool(torch.isfinite(dz).all())):
        return _unchanged(problem, replace(report, status="nonfinite"))

    for attempt in range(halvings + 1 if problem.guard else 1):
        scale = 0.5**attempt
        T_new, disps_new = _moved(problem, T64, free, dx, dz, scale)
        norm = float((scale * dx).norm(dim=1).max()) if n_free else 0.0
        done = replace(report, step_norm=norm)
        if not (bool(torch.isfinite(T_new).all()) and bool(torch.isfinite(disps_new).all())):
            return _unchanged(problem, replace(report, status="nonfinite"))
        if not problem.guard or sums.valid is None:
            return Step(T_new, disps_new, done)
        after = energy(problem, layout, T_new, disps_new, sums.valid, work, chunk)
        after += _prior_energy(problem, disps_new)
        if after <= before:
            return Step(T_new, disps_new, replace(done, cost_after=after))
    return _unchanged(problem, replace(report, status="rejected", cost_after=before))


def _moved(
    problem: BAProblem, T64: Tensor, free: Tensor, dx: Tensor, dz: Tensor, scale: float
) -> tuple[Tensor, Tensor]:
    """Poses and disparities after a scaled step; poses that stay keep their bytes."""
    T_new = problem.T_cw.clone()
    T_new[free] = se3.retract(T64[free], scale * dx[free]).to(T_new.dtype)
    if problem.motion_only:
        return T_new, problem.disps.clone()
    disps = torch.add(problem.disps, dz, alpha=scale)
    return T_new, disps.clamp_(problem.min_disp, problem.max_disp)


def _free_poses(
    problem: BAProblem, layout: Layout, sums: EdgeSums
) -> tuple[Tensor, tuple[int, ...]]:
    """Indices of the poses that move, and of those that are free but see no measurement."""
    # sums of W (1 + a^2)^2 and W (1 + b^2)^2: positive as soon as one weight is
    usable = (sums.gram[:, 4, 4] > 0) | (sums.gram[:, 3, 3] > 0)
    usable &= layout.ii != layout.jj
    seen = torch.zeros_like(problem.fixed)
    seen[layout.ii[usable]] = True
    seen[layout.jj[usable]] = True
    free = torch.nonzero(~problem.fixed & seen).flatten()
    lonely = torch.nonzero(~problem.fixed & ~seen).flatten()
    return free, tuple(int(k) for k in lonely.tolist())


def _depth_can_move(problem: BAProblem, sums: EdgeSums) -> bool:
    """Whether any depth has a measurement or a prior."""
    if problem.motion_only:
        return False
    if bool((sums.gram[:, 6, 6] > 0).any()):
        return True
    has_prior = problem.prior is not None and problem.prior_weight > 0
    return has_prior and bool((_prior(problem) > 0).any())


def _prior(problem: BAProblem) -> Tensor:
    """The prior of the frames whose depth moves (REFERENCE 3.2), 0 elsewhere, [N,h,w]."""
    assert problem.prior is not None
    moves = ~problem.fixed
    moves[problem.ii] = True
    return torch.where(moves[:, None, None], problem.prior, torch.zeros_like(problem.prior))


def _prior_energy(problem: BAProblem, disps: Tensor) -> float:
    """gamma sum (d - D)^2 over the cells with a prior in frames whose depth moves."""
    if problem.prior is None or problem.prior_weight <= 0 or problem.motion_only:
        return 0.0
    prior = _prior(problem)
    off = torch.where(prior > 0, disps - prior, torch.zeros_like(disps))
    return problem.prior_weight * float(off.double().square().sum())


def _towards_prior(problem: BAProblem, dz: Tensor) -> None:
    """Steps of frames without an outgoing edge: straight to their prior, where they have one."""
    if problem.prior is None or problem.prior_weight <= 0:
        return
    prior = _prior(problem)
    torch.where(prior > 0, prior - problem.disps, dz, out=dz)


def _without_nonfinite(problem: BAProblem) -> tuple[BAProblem, int]:
    """The problem with weight 0 on cells whose target or weight is not finite, and their number."""
    usable = torch.isfinite(problem.weight * problem.target.square()).all(-1, keepdim=True)
    zero = torch.zeros_like(problem.target)
    cleaned = replace(
        problem,
        target=torch.where(usable, problem.target, zero),
        weight=torch.where(usable, problem.weight, zero),
    )
    return cleaned, int((~usable).sum())


def _unchanged(problem: BAProblem, report: Report) -> Step:
    """The input again, as fresh tensors."""
    return Step(problem.T_cw.clone(), problem.disps.clone(), report)
