"""The reduced camera system: eliminating the depths, solving in float64, substituting back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from droidw.solve.problem import BAProblem
from droidw_plugins.bundle._layout import Layout, Workspace
from droidw_plugins.bundle._linearise import SIGNS, EdgeSums

__all__ = ["DepthSystem", "back_substitute", "reduce_system", "solve_reduced"]


@dataclass(frozen=True)
class DepthSystem:
    """The diagonal depth part of the normal equations, per source in the layout's order.

    Attributes:
        Q: [K,P] inverse of the depth diagonal, 0 where the diagonal is 0.
        rhs: [K,P] right side.
    """

    Q: Tensor
    rhs: Tensor


def reduce_system(
    problem: BAProblem,
    layout: Layout,
    sums: EdgeSums,
    adjoints: Tensor,
    slots: Tensor,
    n_free: int,
    work: Workspace,
) -> tuple[Tensor, Tensor, DepthSystem | None]:
    """Schur complement of the depths onto the free poses (REFERENCE 3.3).

    With A the map from pose steps to what every edge sees, y_e = dx_j - Ad_e dx_i, the system is
    S = A^T (H - E Q E^T) A, where the inner matrix has one block per source keyframe: the work
    on cells grows with the edges of each source, never with the square of the keyframes.

    Args:
        adjoints: [E,6,6] float64, Ad(G_ij) of the sorted edges.
        slots: [N] position of each pose in the system, `n_free` for a pose that stays.
        n_free: number of poses in the system.

    Returns:
        S [6F,6F] and right side [6F] in float64, undamped, and the depth system (None if
        depths stay).
    """
    device = problem.disps.device
    signs = torch.tensor(SIGNS, dtype=torch.float64, device=device)
    # rows of A^T: what a step of the source does to the edge; for the target it is the identity
    back = -adjoints.transpose(1, 2)
    H = sums.gram[:, :6, :6] * signs * signs[:, None]
    v = sums.gram[:, :6, 7] * signs
    stack = n_free + 1  # the last row and column collect what belongs to poses that stay
    S = torch.zeros(stack * stack, 36, dtype=torch.float64, device=device)
    g = torch.zeros(stack, 6, dtype=torch.float64, device=device)
    si, sj = slots[layout.ii], slots[layout.jj]
    depth = None if sums.depth is None else _depth_system(problem, layout, sums.depth, work)
    for bucket in layout.buckets:
        edges, k, n = slice(bucket.start, bucket.stop), bucket.degree, bucket.last - bucket.first
        D = torch.zeros(n, k, 6, k, 6, dtype=torch.float64, device=device)
        D.diagonal(dim1=1, dim2=3).copy_(H[edges].view(n, k, 6, 6).permute(0, 2, 3, 1))
        rhs = v[edges].view(n, k * 6)
        if depth is not None and sums.coupling is not None:
            n_cells = depth.Q.shape[-1]
            E = sums.coupling[edges].view(n, k * 6, n_cells)
            EQ = work.take("EQ", n, k * 6, n_cells, like=E)
            torch.mul(E, depth.Q[bucket.first : bucket.last, None], out=EQ)
            turn = signs.repeat(k)
            inner = torch.bmm(EQ, E.transpose(1, 2)).double() * turn * turn[:, None]
            D -= inner.view(n, k, 6, k, 6)
            w = depth.rhs[bucket.first : bucket.last, :, None]
            rhs = rhs - torch.bmm(EQ, w)[..., 0].double() * turn
        B = back[edges].view(n, k, 6, 6).transpose(1, 2).reshape(n, 6, k * 6)
        BD = B @ D.view(n, k * 6, k * 6)
        to_source, to_target = si[edges].view(n, k), sj[edges].view(n, k)
        own = to_source[:, 0]
        BD_blocks = BD.view(n, 6, k, 6).permute(0, 2, 1, 3)
        index = torch.cat(
            (
                own * stack + own,
                (to_source * stack + to_target).flatten(),
                (to_target * stack + to_source).flatten(),
                (to_target[:, :, None] * stack + to_target[:, None, :]).flatten(),
            )
        )
        blocks = torch.cat(
            (
                (BD @ B.transpose(1, 2)).reshape(-1, 36),
                BD_blocks.reshape(-1, 36),
                BD_blocks.transpose(2, 3).reshape(-1, 36),
                D.permute(0, 1, 3, 2, 4).reshape(-1, 36),
            )
        )
        S.index_add_(0, index, blocks)
        g.index_add_(0, own, (B @ rhs[..., None])[..., 0])
        g.index_add_(0, to_target.flatten(), rhs.reshape(-1, 6))
    full = S.view(stack, stack, 6, 6)[:n_free, :n_free].permute(0, 2, 1, 3)
    return full.reshape(6 * n_free, 6 * n_free), g[:n_free].reshape(-1), depth


def solve_reduced(S: Tensor, g: Tensor, lm: float, ep: float, floor: float) -> Tensor | None:
    """Solves the damped system by Cholesky, [F,6]; None if it is singular.

    Args:
        lm, ep: diag(S) <- diag(S) * (1 + lm) + ep.
        floor: share of its diagonal entry below which a pivot is taken for rounding, unless
            the damping added more than that.
    """
    S = 0.5 * (S + S.T)
    diagonal = S.diagonal()
    added = lm * diagonal + ep
    # damping of that size vouches for every pivot: the undamped system has no negative ones
    least = torch.where(added < floor * diagonal, floor * diagonal, torch.zeros_like(added))
    diagonal += added
    L, info = torch.linalg.cholesky_ex(S)
    if int(info) != 0 or not bool((L.diagonal().square() > least).all()):
        return None
    return torch.cholesky_solve(g[:, None], L).view(-1, 6)


def back_substitute(
    layout: Layout, sums: EdgeSums, depth: DepthSystem, adjoints: Tensor, dx: Tensor
) -> Tensor:
    """Disparity steps dz = Q (rhs - E^T dx) of the sources, [K,P], for pose steps dx [N,6].

    Every pose that moved takes part, the first free one too (REFERENCE 3.3 notes a kernel that
    leaves it out).
    """
    assert sums.coupling is not None
    dz = depth.rhs.clone()
    signs = torch.tensor(SIGNS, dtype=torch.float64, device=dx.device)
    seen = dx[layout.jj] - (adjoints @ dx[layout.ii, :, None])[..., 0]
    y = (seen * signs).to(dz.dtype)
    for bucket in layout.buckets:
        n = bucket.last - bucket.first
        edges = slice(bucket.start, bucket.stop)
        E = sums.coupling[edges].view(n, bucket.degree * 6, -1)
        dz[bucket.first : bucket.last, None].baddbmm_(
            y[edges].view(n, 1, bucket.degree * 6), E, alpha=-1.0
        )
    return dz.mul_(depth.Q)


def _depth_system(
    problem: BAProblem, layout: Layout, depth: Tensor, work: Workspace
) -> DepthSystem:
    """Sums the depth part over the edges of each source, adds prior or damping (REFERENCE 3.2)."""
    n_cells = depth.shape[-1]
    C = work.take("C", layout.sources.shape[0], n_cells, like=depth)
    rhs = work.take("depth_rhs", layout.sources.shape[0], n_cells, like=depth)
    for bucket in layout.buckets:
        of_edges = depth[bucket.start : bucket.stop]
        grouped = of_edges.view(-1, bucket.degree, 2, n_cells)
        torch.sum(grouped[:, :, 0], 1, out=C[bucket.first : bucket.last])
        torch.sum(grouped[:, :, 1], 1, out=rhs[bucket.first : bucket.last])
    damping = problem.damping.flatten(1)[layout.sources]
    if problem.prior is not None and problem.prior_weight > 0:
        prior = problem.prior.flatten(1)[layout.sources]
        known = (prior > 0).to(C.dtype) * problem.prior_weight
        C += torch.where(prior > 0, known, damping)
        rhs -= known * (problem.disps.flatten(1)[layout.sources] - prior)
    else:
        C += damping
    least = torch.finfo(C.dtype).tiny * 1e8
    Q = torch.where(C > least, C.reciprocal(), torch.zeros_like(C))
    return DepthSystem(Q, rhs)
