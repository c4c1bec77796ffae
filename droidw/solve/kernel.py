"""The kernel that gives up what is far off, and how wide it has to be.

As a step of iteratively reweighted least squares it needs nothing of a bundle adjustment backend:
weights are changed before each step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from droidw.geometry.projective import reproject

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.config.schema import SolverConfig
    from droidw.solve.problem import BAProblem

__all__ = ["median_length", "redescend", "redescended", "usual_square"]

# Bins of squared residual lengths: 32 to an octave, 1.1 per cent of a length each.
_PER_OCTAVE = 32
_LEAST, _MOST = -30, 20
# Cells. Matches without any error would leave a kernel of no width.
_NARROWEST = 1e-3


def redescend(weight: Tensor, residual: Tensor, scale: float | Tensor, slip: float = 0.0) -> Tensor:
    """Weights times those of a Cauchy kernel, `1 / (1 + (s / scale)^2)`.

    The further a measurement lies from what the poses predict, the less it pulls: a Huber kernel
    lets a wrong match pull with a constant force, and many that are wrong alike win.

    Args:
        weight: [E,h,w,2] or [E,h,w,3], information of the matches as in `BAProblem.weight`.
        residual: [E,h,w,2] measured less predicted position, cells.
        scale: s at which a weight halves, cells, > 0, of all or [E] of each edge; s as of
            `BAProblem.huber`, so that a match is judged in the directions in which it is known.
        slip: share of the whole length of a residual that counts besides, >= 0. What has slipped
            along a line is off across it, too, wherever the line bends or turns.
    Returns:
        The shape of `weight`, a fresh tensor. Where residual or weight is not finite, the weight is
        as it was: bundle adjustment counts and drops those.
    """
    if not isinstance(scale, float):
        scale = scale[:, None, None]
    square = _square(weight, residual)
    if slip > 0:
        square = square + slip**2 * residual.square().sum(-1)
    factor = (1.0 + square / scale**2).reciprocal()
    return weight * torch.where(torch.isfinite(factor), factor, 1.0)[..., None]


def median_length(
    weight: Tensor, residual: Tensor, group: Tensor | None = None, groups: int = 1
) -> Tensor:
    """Length s of `redescend` below which half of the weight lies.

    Half of what weighs may be wrong without moving it far, so that it tells how exact the rest is.
    Found in a histogram, to one per cent.

    Args:
        weight, residual: as in `redescend`.
        group: [E] int64 below `groups`, which edges are judged together; None: all.
    Returns:
        [groups], cells; 0 where nothing has weight.
    """
    square, mean = _square(weight, residual), _mean(weight)
    use = torch.isfinite(square) & torch.isfinite(mean)
    bins = (_MOST - _LEAST) * _PER_OCTAVE
    place = (square.clamp_min(2.0**_LEAST).log2_() - _LEAST).mul_(_PER_OCTAVE)
    place = torch.where(use, place, 0.0).long().clamp_(0, bins - 1)
    if group is not None:
        place += bins * group[:, None, None]
    # One order of adding up on a CPU, so that one seed gives the same bytes; float32 loses count.
    total = torch.zeros(groups * bins, dtype=torch.float64, device=weight.device)
    total.index_add_(0, place.flatten(), torch.where(use, mean, 0.0).flatten().double())
    below = total.view(groups, bins).cumsum(-1)
    middle = (below < 0.5 * below[:, -1:]).sum(-1)
    length = torch.exp2(0.5 * ((middle + 0.5) / _PER_OCTAVE + _LEAST))
    return torch.where(below[:, -1] > 0, length, 0.0).to(weight.dtype)


def redescended(
    problem: BAProblem, solver: SolverConfig, group: Tensor | None = None, groups: int = 1
) -> BAProblem:
    """The problem with weights as `redescend` leaves them at its poses and depths.

    The kernel is `solver.cauchy` wide; with `solver.cauchy_tuning` that many times `median_length`,
    if that is less. So it is wide as long as poses are far off, and then as narrow as matches are
    exact. `solver.cauchy_slip` is the `slip` of `redescend`. The problem itself where
    `solver.cauchy` is 0.

    Args:
        group, groups: edges with a width of their own each, as in `median_length`.
    """
    if solver.cauchy == 0:
        return problem
    residual = _residual(problem)
    widest = float(solver.cauchy)
    width: float | Tensor = widest
    if solver.cauchy_tuning > 0:
        typical = median_length(problem.weight, residual, group, groups)
        width = (solver.cauchy_tuning * typical).clamp(min(_NARROWEST, widest), widest)
        width = width.expand(len(residual)) if group is None else width[group]
    weight = redescend(problem.weight, residual, width, solver.cauchy_slip)
    return replace(problem, weight=weight)


def usual_square(problem: BAProblem) -> float:
    """Square of `median_length` of all matches at the poses and depths of the problem, cells^2."""
    return float(median_length(problem.weight, _residual(problem)).square())


def _residual(problem: BAProblem) -> Tensor:
    """Measured less predicted positions, [E,h,w,2] cells."""
    coords, _ = reproject(problem.T_cw, problem.disps, problem.intrinsics, problem.ii, problem.jj)
    return problem.target - coords


def _mean(weight: Tensor) -> Tensor:
    """Mean information of both axes, [E,h,w]."""
    return 0.5 * (weight[..., 0] + weight[..., 1])


def _square(weight: Tensor, residual: Tensor) -> Tensor:
    """Squared length of residuals in the directions in which matches are known, [E,h,w] cells^2."""
    x, y = residual.unbind(-1)
    energy = weight[..., 0] * x * x + weight[..., 1] * y * y
    if weight.shape[-1] == 3:
        energy = energy + 2.0 * weight[..., 2] * x * y
    tiny = torch.finfo(weight.dtype).tiny
    return (energy / _mean(weight).clamp_min(tiny)).clamp_min(0.0)
