"""The damped reduced system on the device: one dense Cholesky, or one over tiles that are not 0.

Nothing is read back from the device, and nothing is sent to it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from droidw_plugins.bundle._kernel_layout import TILE, TilePlan

__all__ = ["solve_dense", "solve_tiled"]


def solve_dense(S: Tensor, g: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Solution [n] of the lower triangle S [n,n], its factor, and the status of the factorisation.

    The pivots are for the caller to judge.
    """
    L, info = torch.linalg.cholesky_ex(S)
    return torch.cholesky_solve(g[:, None], L)[:, 0], L, info


def solve_tiled(tiles: Tensor, plan: TilePlan, g: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
    """The same for tiles [T,TILE,TILE] of the lower triangle, which are overwritten.

    Returns:
        The solution [n], and whether every pivot exceeds `least`.

    The cost follows the tiles that are not 0: for a band it grows with its length.

    Args:
        tiles: as `plan` numbers them; the last one on the diagonal may be filled in part.
        plan: the work.
        g, least: [n], n at most `plan.unknowns`.
    """
    n = g.shape[0]
    last = tiles[plan.columns[-1].at]
    last.diagonal()[TILE - (plan.unknowns - n) :] = 1.0
    x = g.new_zeros(plan.count, TILE)
    x.view(-1)[:n] = g
    bound = g.new_zeros(plan.count, TILE)
    bound.view(-1)[:n] = least
    good = torch.ones((), dtype=torch.bool, device=g.device)
    for k, column in enumerate(plan.columns):
        L, info = torch.linalg.cholesky_ex(tiles[column.at])
        good = good & (info == 0) & (L.diagonal().square() > bound[k]).all()
        tiles[column.at] = L
        x[k] = torch.linalg.solve_triangular(L, x[k, :, None], upper=False)[:, 0]
        m = column.rows.shape[0]
        if m == 0:
            continue
        flat = tiles.index_select(0, column.here).view(m * TILE, TILE)
        panel = torch.linalg.solve_triangular(L.T, flat, upper=True, left=False)
        panel = panel.view(m, TILE, TILE)
        tiles.index_copy_(0, column.here, panel)
        x.index_add_(0, column.rows, (panel @ x[k, :, None])[..., 0], alpha=-1.0)
        # every product has a tile of its own, so that no sum depends on an order
        products = torch.bmm(panel[column.left], panel[column.right].transpose(1, 2))
        tiles.index_add_(0, column.to, products, alpha=-1.0)
    for k in range(plan.count - 1, -1, -1):
        column = plan.columns[k]
        if column.rows.shape[0]:
            below = tiles.index_select(0, column.here).transpose(1, 2)
            x[k] -= (below @ x.index_select(0, column.rows)[..., None]).sum(0)[:, 0]
        L = tiles[column.at]
        x[k] = torch.linalg.solve_triangular(L.T, x[k, :, None], upper=True)[:, 0]
    return x.view(-1)[:n], good
