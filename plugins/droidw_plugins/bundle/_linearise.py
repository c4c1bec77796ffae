"""Per-edge normal equations of the reprojection error, with respect to the target's pose alone.

The Jacobian of the source's pose follows from J_i = -Ad(G_ij)^T J_j, so one set of sums per edge
is enough (REFERENCE 2.3); `_schur` turns 6x6 blocks instead of planes of cells.

Rows are kept in normalised image units and with the signs of two components (t_z, phi_x)
turned, since that saves passes over the planes; `SIGNS` takes them back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from droidw.geometry import se3
from droidw.geometry.projective import NEAR, pixel_grid
from droidw.geometry.transfer import on_device
from droidw.solve.problem import BAProblem
from droidw_plugins.bundle._cross import Pivots, cross_products, cross_rows, pivots
from droidw_plugins.bundle._layout import Layout, Workspace

__all__ = ["SIGNS", "EdgeMotions", "EdgeSums", "edge_motions", "energy", "linearise"]

SIGNS = (1.0, 1.0, -1.0, -1.0, 1.0, 1.0)
"""What the six pose components of every sum are multiplied by, once per component."""

# Which components the rows of the u and v parts are: five of the pose that are not 0, J_z,
# residual. The order lets one pass over both parts fill a row.
_U_ROWS = (0, 2, 3, 4, 5, 6, 7)
_V_ROWS = (1, 2, 4, 3, 5, 6, 7)
_U_SIGNS = (1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 1.0)


@dataclass(frozen=True)
class EdgeMotions:
    """Relative motions G_ij of the sorted edges: R [E,3,3] and t [E,3] in float64."""

    R: Tensor
    t: Tensor

    def adjoints(self) -> Tensor:
        """Ad(G_ij), [E,6,6]."""
        Ad = self.R.new_zeros(self.R.shape[0], 6, 6)
        Ad[:, :3, :3] = self.R
        Ad[:, 3:, 3:] = self.R
        torch.bmm(se3.skew(self.t), self.R, out=Ad[:, :3, 3:])
        return Ad


def edge_motions(T_cw: Tensor, layout: Layout) -> EdgeMotions:
    """G_ij = T_j T_i^-1 of the sorted edges for poses [N,7], with unit quaternions restored."""
    T = se3.normalise(T_cw.double())
    R, t = se3.rotation(T), T[:, :3]
    R_ij = torch.bmm(R[layout.jj], R[layout.ii].transpose(1, 2))
    return EdgeMotions(R_ij, t[layout.jj] - torch.bmm(R_ij, t[layout.ii, :, None])[..., 0])


@dataclass(frozen=True)
class EdgeSums:
    """Sums over the cells of each edge, in the order of the layout.

    Attributes:
        gram: [E,8,8] float64, of the weighted rows (six pose components, J_z, residual).
        coupling: [E,6,P] sum over x/y of W J_z J_j, or None if depths stay.
        depth: [E,2,P] sums over x/y of W J_z^2 and W J_z r, or None if depths stay.
        valid: [E,P] 1 where the cell passes the near test, else 0; None unless asked for.
    """

    gram: Tensor
    coupling: Tensor | None
    depth: Tensor | None
    valid: Tensor | None


@dataclass(frozen=True)
class _Chunk:
    """A run of edges with the projection of their cells and the residual, in cells."""

    part: slice
    d: Tensor  # [n,P] disparity in the source
    ab: Tensor  # [n,2,P] X / Z, Y / Z
    ba: Tensor  # [n,2,P] Y / Z, X / Z
    inv_z: Tensor  # [n,P] 1 / Z, with Z clamped to NEAR
    ok: Tensor  # [n,P] 1 where Z >= NEAR
    weight: Tensor  # [n,2,P]
    r: Tensor  # [n,2,P]
    cross: Pivots | None  # weight and r are of its two measurements, where there is one


def linearise(
    problem: BAProblem,
    layout: Layout,
    motions: EdgeMotions,
    work: Workspace,
    chunk: int,
    keep_valid: bool,
) -> EdgeSums:
    """Normal equations of every edge.

    Args:
        problem: its target and weight should be finite; if not, `gram` is not finite either.
        layout: order of the edges.
        motions: of the sorted edges, at the poses of the problem.
        work: scratch space; `coupling`, `depth` and `valid` live in it.
        chunk: cells worked on at a time.
        keep_valid: fill `valid`.
    """
    like = problem.disps
    n_edges, n_cells = layout.ii.shape[0], like.shape[-2] * like.shape[-1]
    focal = problem.intrinsics[:2, None].to(like.dtype)
    gram = torch.zeros(n_edges, 8, 8, dtype=torch.float64, device=like.device)
    coupling = depth = None
    if not problem.motion_only:
        coupling = work.take("coupling", n_edges, 6, n_cells, like=like)
        depth = work.take("depth", n_edges, 2, n_cells, like=like)
    valid = work.take("valid", n_edges, n_cells, like=like) if keep_valid else None
    u_rows, v_rows = on_device(_U_ROWS, like.device), on_device(_V_ROWS, like.device)
    u_signs = on_device(_U_SIGNS, like.device, torch.float64)
    t = motions.t.to(like.dtype)
    for c in _project(problem, layout, motions, problem.disps, work, chunk):
        n = c.d.shape[0]
        if valid is not None:
            valid[c.part] = c.ok
        planes = None if coupling is None or depth is None else (coupling[c.part], depth[c.part])
        if c.cross is not None:
            root = _roots(c, problem.huber, work)
            h = c.d.mul_(c.inv_z)
            every = cross_rows(root, c.cross.k, c.r, h, c.ab, c.inv_z, t[c.part], focal, work)
            cross_products(every, gram[c.part], planes)
            continue
        rows = work.take("rows", n, 2, 7, n_cells, like=like)
        _weighted_rows(c, t[c.part], focal, problem.huber, rows, work, problem.motion_only)
        flat = rows.view(2 * n, 7, n_cells)
        products = torch.bmm(flat, flat.transpose(1, 2)).view(n, 2, 7, 7).double()
        out = gram[c.part]
        out[:, u_rows[:, None], u_rows] = products[:, 0] * u_signs * u_signs[:, None]
        out[:, v_rows[:, None], v_rows] += products[:, 1]
        if planes is not None:
            _depth_products(rows, *planes)
    return EdgeSums(gram, coupling, depth, valid)


def energy(
    problem: BAProblem,
    layout: Layout,
    T_cw: Tensor,
    disps: Tensor,
    valid: Tensor,
    work: Workspace,
    chunk: int,
) -> Tensor:
    """Robust reprojection energy of other poses and depths, summed in float64, a scalar tensor.

    Counts exactly the cells of `valid`, those that passed the near test at the start of the
    step; one that has come too near since is charged at its clamped depth, so that nothing is
    gained by pushing points behind a camera.
    """
    total = torch.zeros((), dtype=torch.float64, device=disps.device)
    motions = edge_motions(T_cw, layout)
    for c in _project(problem, layout, motions, disps, work, chunk):
        weight = c.weight * valid[c.part].unsqueeze(1)
        cells = (weight * c.r * c.r).sum(1)
        if problem.huber is not None:
            knee = problem.huber / _length(c, cells, weight).clamp_(min=problem.huber)
            cells *= knee * (2.0 - knee)  # 1 inside the threshold, (2hs - h^2) / s^2 outside
        total += cells.sum(1).double().sum()
    return total


def _length(c: _Chunk, cells: Tensor, weight: Tensor) -> Tensor:
    """Residual length s [n,P] that a robust kernel sees, cells.

    Where the weights [n,2,P] of directions differ, so do their shares: s^2 = r^T W r / mean(W),
    with r^T W r in `cells` and half of the trace of W as the mean. The reweighted step is then the
    exact gradient of mean(W) rho(s).
    """
    mean = weight.mean(1) if c.cross is None else c.cross.mean
    return (cells / mean.clamp_(min=torch.finfo(weight.dtype).tiny)).sqrt_()


def _project(
    problem: BAProblem,
    layout: Layout,
    motions: EdgeMotions,
    disps: Tensor,
    work: Workspace,
    chunk: int,
) -> Iterator[_Chunk]:
    """Projects the cells of every edge, a run of edges at a time, into reused buffers."""
    like = problem.disps
    h, w = like.shape[-2:]
    n_edges, n_cells = layout.ii.shape[0], h * w
    fx, fy, cx, cy = problem.intrinsics.to(like.dtype).unbind()
    # the second coordinate twice: (Y, X, Y, Z) holds both (X, Y) and (Y, X) as runs of planes
    twice = on_device((1, 0, 1, 2), like.device)
    R, t = motions.R[:, twice].to(like.dtype), motions.t[:, twice].to(like.dtype)
    intrinsics = problem.intrinsics.to(like.dtype)[:, None]
    focal, centre = intrinsics[:2], intrinsics[2:]
    rays = torch.ones(3, n_cells, dtype=like.dtype, device=like.device)
    xy = pixel_grid(h, w, like.dtype, like.device).view(-1, 2)
    torch.div(xy[:, 0] - cx, fx, out=rays[0])
    torch.div(xy[:, 1] - cy, fy, out=rays[1])
    flat = disps.reshape(-1, n_cells)
    targets = problem.target.reshape(-1, 2 * n_cells)
    channels = problem.channels
    weights = problem.weight.reshape(-1, channels * n_cells)
    size = max(1, chunk // n_cells)
    for start in range(0, n_edges, size):
        part = slice(start, min(start + size, n_edges))
        n = part.stop - part.start
        index = layout.order[part]
        d = work.take("d", n, n_cells, like=like)
        torch.index_select(flat, 0, layout.ii[part], out=d)
        target = work.take("target", n, 2 * n_cells, like=like)
        torch.index_select(targets, 0, index, out=target)
        weight = work.take("weight", n, channels * n_cells, like=like)
        torch.index_select(weights, 0, index, out=weight)
        points = work.take("points", n, 4, n_cells, like=like)
        torch.mm(R[part].reshape(-1, 3), rays, out=points.view(-1, n_cells))
        points.addcmul_(t[part, :, None], d[:, None])
        Z = points[:, 3]
        ok = work.take("ok", n, n_cells, like=like)
        torch.ge(Z, NEAR, out=ok)
        inv_z = Z.clamp_(min=NEAR).reciprocal_()
        points[:, :3] *= inv_z[:, None]
        ba, ab = points[:, :2], points[:, 1:3]
        r = work.take("residual", n, 2, n_cells, like=like)
        torch.addcmul(target.view(n, n_cells, 2).transpose(1, 2), ab, focal, value=-1.0, out=r)
        r -= centre
        cross = pivots(weight.view(n, n_cells, 3)) if channels == 3 else None
        if cross is None:
            weight = weight.view(n, n_cells, 2).transpose(1, 2)
        else:
            weight = cross.weight
            r[:, 0].addcmul_(cross.k, r[:, 1])
        yield _Chunk(part, d, ab, ba, inv_z, ok, weight, r, cross)


def _roots(c: _Chunk, huber: float | None, work: Workspace) -> Tensor:
    """Square roots [n,2,P] of the weights, robust ones where there is a kernel."""
    root = work.take("root", *c.r.shape, like=c.d)
    torch.mul(c.weight, c.ok[:, None], out=root)
    if huber is not None:
        # iteratively reweighted least squares: weight h / s beyond the threshold
        length = _length(c, (root * c.r * c.r).sum(1), root)
        root *= (huber / length.clamp_(min=huber)).unsqueeze(1)
    return root.sqrt_()


def _weighted_rows(
    c: _Chunk,
    t: Tensor,
    focal: Tensor,
    huber: float | None,
    rows: Tensor,
    work: Workspace,
    motion_only: bool,
) -> None:
    """Fills rows [n,2,7,P] with sqrt(W) times the Jacobian and the residual (REFERENCE 2.3).

    Per part and in this order, with h the disparity in j: (h, ah, ab, 1+a^2, b, J_z, r) for u and
    (h, bh, ab, 1+b^2, a, J_z, r) for v, all but r times the focal length.
    """
    root = _roots(c, huber, work)
    torch.mul(root, c.r, out=rows[:, :, 6])
    root *= focal
    h = c.d.mul_(c.inv_z)
    both = torch.mul(root, c.ab, out=c.r)  # the residual is in its row: its planes are free
    torch.mul(root, h[:, None], out=rows[:, :, 0])
    torch.mul(rows[:, :, 0], c.ab, out=rows[:, :, 1])
    torch.mul(both, c.ba, out=rows[:, :, 2])
    torch.addcmul(root, both, c.ab, out=rows[:, :, 3])
    torch.mul(root, c.ba, out=rows[:, :, 4])
    if motion_only:
        rows[:, :, 5] = 0.0
        return
    # J_z: (t_x - t_z a) / Z and (t_y - t_z b) / Z
    root *= c.inv_z[:, None]
    torch.addcmul(t[:, :2, None], c.ab, t[:, 2:, None], value=-1.0, out=both)
    torch.mul(root, both, out=rows[:, :, 5])


def _depth_products(rows: Tensor, coupling: Tensor, depth: Tensor) -> None:
    """W J_z J_j into coupling [n,6,P]; W J_z^2 and W J_z r into depth [n,2,P]."""
    u, v = rows[:, 0], rows[:, 1]
    ju, jv = u[:, 5], v[:, 5]
    torch.mul(u[:, 0], ju, out=coupling[:, 0])
    torch.mul(v[:, 0], jv, out=coupling[:, 1])
    torch.mul(u[:, 1:5], ju[:, None], out=coupling[:, 2:])
    coupling[:, 2].addcmul_(v[:, 1], jv)
    coupling[:, 3].addcmul_(v[:, 3], jv)
    coupling[:, 4].addcmul_(v[:, 2], jv)
    # the one sign that differs between u and v
    coupling[:, 5].neg_().addcmul_(v[:, 4], jv)
    torch.mul(u[:, 5:], ju[:, None], out=depth)
    depth.addcmul_(v[:, 5:], jv[:, None])
