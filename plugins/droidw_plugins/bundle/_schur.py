"""The reduced camera system: eliminating the depths, solving in float64, substituting back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from droidw.geometry.transfer import on_device
from droidw.solve.problem import BAProblem, PoseTerm
from droidw_plugins.bundle._layout import Layout, Workspace
from droidw_plugins.bundle._linearise import SIGNS, EdgeSums

__all__ = [
    "DepthSystem",
    "add_pose_term",
    "back_substitute",
    "reduce_system",
    "solve_reduced",
]


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
    signs = on_device(SIGNS, sums.gram.device, sums.gram.dtype)
    turn = signs * signs[:, None]
    X = sums.gram[:, :6, :6] * turn
    rhs = sums.gram[:, :6, 7] * signs
    pair_a = pair_b = torch.arange(X.shape[0], device=X.device)
    depth = None
    if sums.depth is not None and sums.coupling is not None:
        depth = _depth_system(problem, layout, sums.depth, work)
        seen, seen_rhs = _eliminated(layout, sums.coupling, depth, work)
        alone = X
        X = seen.double().mul_(-turn)
        X[layout.own] += alone  # every edge is once its own partner
        rhs -= seen_rhs.double() * signs
        pair_a, pair_b = layout.pair_a, layout.pair_b
    # what a step of the source does to the edge; for a step of the target it is the identity
    back = -adjoints.transpose(1, 2)
    back_b = back[pair_b].transpose(1, 2)
    BX = torch.bmm(back[pair_a], X)
    stack = n_free + 1  # the last row and column collect what belongs to poses that stay
    si, sj = slots[layout.ii], slots[layout.jj]
    rows_i, rows_j, columns_i, columns_j = si[pair_a], sj[pair_a], si[pair_b], sj[pair_b]
    rows = torch.cat((rows_i, rows_i, rows_j, rows_j))
    columns = torch.cat((columns_i, columns_j, columns_i, columns_j))
    blocks = torch.cat((torch.bmm(BX, back_b), BX, torch.bmm(X, back_b), X))
    S = X.new_zeros(stack * stack, 36)
    S.index_add_(0, rows * stack + columns, blocks.view(-1, 36))
    g = X.new_zeros(stack, 6)
    g.index_add_(0, si, torch.bmm(back, rhs[..., None])[..., 0])
    g.index_add_(0, sj, rhs)
    full = S.view(stack, stack, 6, 6)[:n_free, :n_free].permute(0, 2, 1, 3)
    return full.reshape(6 * n_free, 6 * n_free), g[:n_free].reshape(-1), depth


def add_pose_term(S: Tensor, g: Tensor, term: PoseTerm, slots: Tensor, n_free: int) -> None:
    """Adds the band of the term to S [6F,6F] and its right side to g [6F], in place.

    Args:
        slots, n_free: as in `reduce_system`; poses that stay have no part in it.
    """
    blocks, right = S.view(n_free, 6, n_free, 6), g.view(n_free, 6)
    moves = slots < n_free
    term = term.to(S.device)
    right += term.rhs[moves]
    for m in range(min(term.band.shape[1], len(slots))):
        row, column = slots[m:], slots[: len(slots) - m]
        both = (row < n_free) & (column < n_free)
        row, column, block = row[both], column[both], term.band[m:, m][both]
        # each block has a place of its own, so that no sum depends on an order
        blocks[row, :, column] += block
        if m:
            blocks[column, :, row] += block.transpose(1, 2)


def solve_reduced(
    S: Tensor, g: Tensor, lm: float, ep: float, floor: float
) -> tuple[Tensor, Tensor]:
    """Solves the damped system by Cholesky, [F,6], and says in a scalar whether that went well.

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
    sound = (info == 0) & (L.diagonal().square() > least).all()
    return torch.cholesky_solve(g[:, None], L).view(-1, 6), sound


def back_substitute(
    layout: Layout, sums: EdgeSums, depth: DepthSystem, adjoints: Tensor, dx: Tensor
) -> Tensor:
    """Disparity steps dz = Q (rhs - E^T dx) of the sources, [K,P], for pose steps dx [N,6].

    Every pose that moved takes part, the first free one too (REFERENCE 3.3 notes a kernel that
    leaves it out).
    """
    assert sums.coupling is not None
    dz = depth.rhs.clone()
    signs = on_device(SIGNS, dx.device, dx.dtype)
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


def _eliminated(
    layout: Layout, coupling: Tensor, depth: DepthSystem, work: Workspace
) -> tuple[Tensor, Tensor]:
    """E Q E^T of all pairs of edges with one source [M,6,6], and E Q rhs [E,6], signs turned."""
    n_edges, _, n_cells = coupling.shape
    blocks = coupling.new_empty(layout.pair_a.shape[0], 6, 6)
    rhs = coupling.new_empty(n_edges, 6)
    first_pair = 0
    for bucket in layout.buckets:
        n, k = bucket.last - bucket.first, bucket.degree
        of_sources = slice(bucket.first, bucket.last)
        E = coupling[bucket.start : bucket.stop].view(n, k * 6, n_cells)
        EQ = work.take("EQ", n, k * 6, n_cells, like=E)
        torch.mul(E, depth.Q[of_sources, None], out=EQ)
        inner = torch.bmm(EQ, E.transpose(1, 2)).view(n, k, 6, k, 6)
        last_pair = first_pair + n * k * k
        blocks[first_pair:last_pair].view(n, k, k, 6, 6).copy_(inner.transpose(2, 3))
        # a row times a matrix: the column form of the same product takes fifteen times as long
        product = torch.bmm(depth.rhs[of_sources, None], EQ.transpose(1, 2))
        rhs[bucket.start : bucket.stop].view(n, 1, k * 6).copy_(product)
        first_pair = last_pair
    return blocks, rhs


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
    Q = torch.where(least < C, C.reciprocal(), torch.zeros_like(C))
    return DepthSystem(Q, rhs)
