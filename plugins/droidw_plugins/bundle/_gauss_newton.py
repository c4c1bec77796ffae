"""One Gauss-Newton step in torch: order, linearise, reduce, solve, substitute, guard."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from droidw.geometry import se3
from droidw.geometry.transfer import on_device
from droidw.solve.problem import BAProblem, Report, Step
from droidw_plugins.bundle._layout import Layout, Workspace, make_layout
from droidw_plugins.bundle._linearise import EdgeSums, edge_motions, energy, linearise
from droidw_plugins.bundle._schur import (
    add_pose_term,
    back_substitute,
    reduce_system,
    solve_reduced,
)

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
    layout = make_layout(problem)
    if problem.pose_term is not None:
        problem.pose_term.check(len(problem.T_cw))
    T64 = problem.T_cw.double()
    motions = edge_motions(problem.T_cw, layout)
    # the sums hold the energy at the start, but neither a robust one nor one to compare with
    separate = problem.guard or problem.huber is not None
    sums = linearise(problem, layout, motions, work, chunk, separate)
    start = _look(problem, layout, sums, work, chunk)
    dropped = 0
    if not start.finite:
        problem, dropped = _without_unusable(problem)
        sums = linearise(problem, layout, motions, work, chunk, separate)
        start = _look(problem, layout, sums, work, chunk)
        if not start.finite:
            return _unchanged(problem, Report("nonfinite", math.nan, dropped=dropped))

    before = start.energy
    report = Report("ok", before, dropped=dropped, isolated=start.isolated)
    if not start.free and not _depth_can_move(problem, sums):
        return _unchanged(problem, replace(report, status="empty"))

    n_free = len(start.free)
    free = on_device(start.free, problem.disps.device)
    slots = torch.full_like(problem.fixed, n_free, dtype=torch.int64)
    slots[free] = torch.arange(n_free, device=free.device)
    adjoints = motions.adjoints()
    S, g, depth = reduce_system(problem, layout, sums, adjoints, slots, n_free, work)
    if problem.pose_term is not None:
        add_pose_term(S, g, problem.pose_term, slots, n_free)
    dx = torch.zeros(problem.T_cw.shape[0], 6, dtype=torch.float64, device=S.device)
    sound = torch.ones((), dtype=torch.bool, device=S.device)
    if n_free:
        floor = _PIVOT_FLOOR.get(problem.disps.dtype, 1e-5)
        dx[free], sound = solve_reduced(S, g, problem.lm, problem.ep, floor)
    dz = torch.zeros_like(problem.disps)
    if depth is not None:
        _towards_prior(problem, dz)
        moved = back_substitute(layout, sums, depth, adjoints, dx)
        dz[layout.sources] = moved.view(-1, *dz.shape[1:])
    steps = torch.isfinite(dx).all() & torch.isfinite(dz).all()

    for attempt in range(halvings + 1 if problem.guard else 1):
        scale = 0.5**attempt
        T_new, disps_new = _moved(problem, T64, free, dx, dz, scale)
        state = torch.isfinite(T_new).all() & torch.isfinite(disps_new).all()
        norm = (scale * dx).norm(dim=1).max() if n_free else dx.new_zeros(())
        compared = problem.guard and sums.valid is not None
        told = [sound, steps, state, norm]
        if compared and sums.valid is not None:
            told.append(energy(problem, layout, T_new, disps_new, sums.valid, work, chunk))
            told.append(_prior_energy(problem, disps_new))
            if problem.pose_term is not None:
                told.append(problem.pose_term.energy(scale * dx))
        well, step_finite, state_finite, size, *after = _read(told)
        if not well:
            return _unchanged(problem, replace(report, status="singular"))
        if not (step_finite and state_finite):
            return _unchanged(problem, replace(report, status="nonfinite"))
        done = replace(report, step_norm=size)
        if not compared:
            return Step(T_new, disps_new, done)
        reached = after[0] + problem.prior_weight * after[1] + sum(after[2:])
        if reached <= before:
            return Step(T_new, disps_new, replace(done, cost_after=reached))
    return _unchanged(problem, replace(report, status="rejected", cost_after=before))


@dataclass(frozen=True)
class _Start:
    """What the host must know of a problem before it can go on.

    Attributes:
        finite: all sums are. energy: at the start.
        free: poses that move. isolated: those that are free but see no measurement.
    """

    finite: bool
    energy: float
    free: list[int]
    isolated: tuple[int, ...]


def _look(
    problem: BAProblem, layout: Layout, sums: EdgeSums, work: Workspace, chunk: int
) -> _Start:
    """All of that in one transfer, since each of them waits for a GPU."""
    if sums.valid is not None:
        cost = energy(problem, layout, problem.T_cw, problem.disps, sums.valid, work, chunk)
    else:
        cost = sums.gram[:, 7, 7].sum()
    seen = _seen(problem, layout, sums)
    states = (~problem.fixed).double() * (1.0 + seen.double())
    finite = torch.isfinite(sums.gram).all()
    told = _read([finite, cost, _prior_energy(problem, problem.disps)], states)
    return _Start(
        finite=bool(told[0]),
        energy=problem.prior_weight * told[2] + told[1],
        free=[k for k, state in enumerate(told[3:]) if state == 2.0],
        isolated=tuple(k for k, state in enumerate(told[3:]) if state == 1.0),
    )


def _read(numbers: Sequence[Tensor], more: Tensor | None = None) -> list[float]:
    """Scalars, and the entries of a float64 vector behind them, as numbers of the host."""
    whole = torch.stack([n.double() for n in numbers])
    found: list[float] = (whole if more is None else torch.cat([whole, more])).tolist()
    return found


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


def _seen(problem: BAProblem, layout: Layout, sums: EdgeSums) -> Tensor:
    """Poses [N] with a measurement."""
    # sums of W (1 + a^2)^2 and W (1 + b^2)^2: positive as soon as one weight is
    usable = (sums.gram[:, 4, 4] > 0) | (sums.gram[:, 3, 3] > 0)
    usable &= layout.ii != layout.jj
    count = torch.zeros_like(problem.fixed, dtype=torch.int64)
    count.index_add_(0, layout.ii, usable.long()).index_add_(0, layout.jj, usable.long())
    return count > 0


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
    moves.index_fill_(0, problem.ii, True)
    return torch.where(moves[:, None, None], problem.prior, torch.zeros_like(problem.prior))


def _prior_energy(problem: BAProblem, disps: Tensor) -> Tensor:
    """Sum of (d - D)^2 over the cells with a prior in frames whose depth moves, a scalar."""
    if problem.prior is None or problem.prior_weight <= 0 or problem.motion_only:
        return disps.new_zeros((), dtype=torch.float64)
    prior = _prior(problem)
    off = torch.where(prior > 0, disps - prior, torch.zeros_like(disps))
    return off.double().square().sum()


def _towards_prior(problem: BAProblem, dz: Tensor) -> None:
    """Steps of frames without an outgoing edge: straight to their prior, where they have one."""
    if problem.prior is None or problem.prior_weight <= 0:
        return
    prior = _prior(problem)
    torch.where(prior > 0, prior - problem.disps, dz, out=dz)


def _without_unusable(problem: BAProblem) -> tuple[BAProblem, int]:
    """The problem with weight 0 on cells that cannot be used, and their number.

    Those whose target or weight is not finite, or whose information is below 0.
    """
    target, weight = problem.target, problem.weight
    diagonal = weight[..., :2]
    usable = (torch.isfinite(diagonal * target.square()) & (diagonal >= 0)).all(-1, keepdim=True)
    if problem.channels == 3:
        usable &= torch.isfinite(weight[..., 2:] * target.prod(-1, keepdim=True))
    zero = target.new_zeros(())
    cleaned = replace(
        problem,
        target=torch.where(usable, target, zero),
        weight=torch.where(usable, weight, zero),
    )
    return cleaned, int((~usable).sum())


def _unchanged(problem: BAProblem, report: Report) -> Step:
    """The input again, as fresh tensors."""
    return Step(problem.T_cw.clone(), problem.disps.clone(), report)
