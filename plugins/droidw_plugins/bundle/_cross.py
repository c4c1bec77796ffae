"""Rows of cells whose information has an off-diagonal part, [[xx, xy], [xy, yy]].

W is taken apart as r^T W r = xx (r_u + k r_v)^2 + (yy - xy k) r_v^2 with k = xy / xx: two
independent measurements, the first of which sees the Jacobian of u + k v. No pose component of
that row is always 0, so that rows hold all of them, in order; their signs are `_linearise.SIGNS`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from droidw_plugins.bundle._layout import Workspace

__all__ = ["LEAST_PIVOT", "Pivots", "cross_products", "cross_rows", "pivots"]

LEAST_PIVOT = 1e-12
"""Least xx / yy that is divided by (csrc/cell.h): below it xy, at most their geometric mean, is
left out."""


@dataclass(frozen=True)
class Pivots:
    """Two independent measurements of n edges.

    Attributes:
        weight: [n,2,P] of the first and of the second. k: [n,P].
        mean: [n,P] half of the trace of the information.
    """

    weight: Tensor
    k: Tensor
    mean: Tensor


def pivots(information: Tensor) -> Pivots:
    """From the information [n,P,3] (xx, yy, xy); a second pivot below 0 is rounding."""
    xx, yy, xy = information.unbind(-1)
    k = torch.where(xx > LEAST_PIVOT * yy, xy / xx, torch.zeros_like(xx))
    second = (yy - xy * k).clamp_(min=0.0)  # NaN stays NaN
    return Pivots(torch.stack((xx, second), 1), k, 0.5 * (xx + yy))


def cross_rows(
    root: Tensor,
    k: Tensor,
    r: Tensor,
    h: Tensor,
    ab: Tensor,
    inv_z: Tensor,
    t: Tensor,
    focal: Tensor,
    work: Workspace,
) -> Tensor:
    """Rows [n,2,8,P] of both measurements: six pose components, J_z, residual (REFERENCE 2.3).

    Args:
        root: [n,2,P] square roots of their weights. k: [n,P]. r: [n,2,P] their residuals, cells.
        h: [n,P] disparity in j. ab: [n,2,P] X / Z, Y / Z. inv_z: [n,P] 1 / Z.
        t: [n,3] of the relative motion. focal: [2,1].
    """
    n, n_cells = h.shape
    rows = work.take("cross_rows", n, 2, 8, n_cells, like=h)
    torch.mul(root, r, out=rows[:, :, 7])
    u_u = root[:, 0] * focal[0]  # what the first row takes of u and of v, and the second of v
    u_v = root[:, 0] * k * focal[1]
    v_v = root[:, 1] * focal[1]
    a, b = ab.unbind(1)
    zero, one, both = torch.zeros_like(h), torch.ones_like(h), a * b
    zu, zv = ((t[:, c, None] - t[:, 2, None] * ab[:, c]) * inv_z for c in (0, 1))
    of_u = (h, zero, a * h, both, one + a * a, -b, zu)
    of_v = (zero, h, b * h, one + b * b, both, a, zv)
    for c, (u, v) in enumerate(zip(of_u, of_v, strict=True)):
        torch.mul(u_u, u, out=rows[:, 0, c]).addcmul_(u_v, v)
        torch.mul(v_v, v, out=rows[:, 1, c])
    return rows


def cross_products(rows: Tensor, gram: Tensor, planes: tuple[Tensor, Tensor] | None) -> None:
    """Adds the products of the rows to gram [n,8,8], and fills the planes if depths move.

    Args:
        planes: coupling [n,6,P] gets W J_z J_j; depth [n,2,P] gets W J_z^2 and W J_z r.
    """
    n, _, _, n_cells = rows.shape
    flat = rows.view(2 * n, 8, n_cells)
    gram += torch.bmm(flat, flat.transpose(1, 2)).view(n, 2, 8, 8).double().sum(1)
    if planes is None:
        return
    for part, out in zip((slice(0, 6), slice(6, 8)), planes, strict=True):
        torch.mul(rows[:, 0, part], rows[:, 0, 6:7], out=out)
        out.addcmul_(rows[:, 1, part], rows[:, 1, 6:7])
