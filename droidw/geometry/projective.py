"""Projection between keyframes: reprojection, Jacobians and the frame distance (REFERENCE 2, 5.5).

A cell (x, y) of frame i with disparity d is the homogeneous point [(x-cx)/fx, (y-cy)/fy, 1, d];
in frame j it is X_j = (R X + d t, d) with G_ij = T_j T_i^-1. Its third coordinate Z is therefore
*relative* depth, and the near test Z >= 0.25 is a ratio, not a length.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from droidw.geometry import se3

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "FAR_DISTANCE",
    "NEAR",
    "depth_there",
    "frame_distance",
    "jacobians",
    "pixel_grid",
    "relative_pose",
    "reproject",
    "viewing_rays",
]

NEAR = 0.25
"""Least relative depth Z of a usable cell."""

FAR_DISTANCE = 1000.0
"""Frame distance where fewer than three quarters of the cells can be compared."""

_MIN_SHARE = 0.75
# Cells that `frame_distance` works on at a time: its planes then stay in the processor's cache.
_CHUNK_CELLS = 1 << 16
# A GPU has no use for that, and each part costs it launches.
_CHUNK_CELLS_GPU = 1 << 22


def pixel_grid(
    h: int,
    w: int,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> Tensor:
    """Coordinates (x, y) of the cell centres, [h, w, 2]; centres are integers from 0."""
    y, x = torch.meshgrid(
        torch.arange(h, dtype=dtype, device=device),
        torch.arange(w, dtype=dtype, device=device),
        indexing="ij",
    )
    return torch.stack((x, y), dim=-1)


def relative_pose(T_cw: Tensor, ii: Tensor, jj: Tensor) -> Tensor:
    """G_ij = T_j T_i^-1, [E, 7]: moves points of camera i into camera j."""
    return se3.mul(T_cw[jj], se3.inv(T_cw[ii]))


def reproject(
    T_cw: Tensor, disps: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor
) -> tuple[Tensor, Tensor]:
    """Where the cells of frames ii fall in frames jj.

    Args:
        T_cw: [N, 7] world to camera.
        disps: [N, h, w] inverse depth.
        intrinsics: [4] fx fy cx cy of the grid.
        ii, jj: [E] int64.

    Returns:
        coords [E, h, w, 2], finite everywhere (Z is clamped to `NEAR` for the division), and
        valid [E, h, w] bool, Z >= `NEAR`. Whether a cell falls inside the image is not tested.
    """
    n_edges, (h, w) = ii.shape[0], disps.shape[-2:]
    G = relative_pose(T_cw, ii, jj)
    K, K_inv = _camera_matrices(intrinsics.to(disps.dtype))
    # K R K^-1 [x y 1] + d K t: pixels go straight to (u Z, v Z, Z)
    KR = (K @ se3.rotation(G) @ K_inv).to(disps.dtype)
    Kt = (G[:, :3] @ K.T).to(disps.dtype)
    points = _transform(KR, Kt, _homogeneous(h, w, disps), disps.flatten(1).index_select(0, ii))
    Z = points[:, 2]
    uv = points[:, :2] / Z.clamp_min(NEAR)[:, None]
    coords = uv.transpose(1, 2).contiguous().view(n_edges, h, w, 2)
    return coords, (Z >= NEAR).view(n_edges, h, w)


def viewing_rays(h: int, w: int, intrinsics: Tensor) -> Tensor:
    """Viewing rays [h, w, 3] of the cells, of depth 1; intrinsics [4] of the grid."""
    fx, fy, cx, cy = intrinsics.unbind()
    x = (torch.arange(w, device=intrinsics.device) - cx) / fx
    y = (torch.arange(h, device=intrinsics.device) - cy) / fy
    yy, xx = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([xx, yy, torch.ones_like(xx)], -1)


def depth_there(T_cw: Tensor, disps: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor) -> Tensor:
    """Depth that the cells of frames ii have in frames jj, [E, h, w]; may be negative.

    Args: as of `reproject`.
    """
    G = relative_pose(T_cw, ii, jj)
    rays = viewing_rays(disps.shape[-2], disps.shape[-1], intrinsics)
    along = torch.einsum("ec,hwc->ehw", se3.rotation(G)[:, 2], rays)
    return along / disps[ii] + G[:, 2, None, None]


def jacobians(
    T_cw: Tensor, disps: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of the projection of `reproject`, in the readable form (REFERENCE 2.3).

    The bundle adjusters use fused forms of the same and are tested against this.

    Returns:
        J_i, J_j [E, h, w, 2, 6] with respect to left perturbations of the poses of i and j,
        and J_z [E, h, w, 2] with respect to the disparity of the cell; 0 where Z < `NEAR`.
    """
    n_edges, (h, w) = ii.shape[0], disps.shape[-2:]
    G = relative_pose(T_cw, ii, jj)
    fx, fy, _, _ = intrinsics.unbind()
    _, K_inv = _camera_matrices(intrinsics.to(disps.dtype))
    d = disps.flatten(1)[ii]
    rays = K_inv @ _homogeneous(h, w, disps)
    X, Y, Z = _transform(se3.rotation(G), G[:, :3], rays, d).unbind(1)
    inv_z = torch.where(Z >= NEAR, 1.0 / Z.clamp_min(NEAR), torch.zeros_like(Z))
    valid = (Z >= NEAR).to(d.dtype)
    a, b, e, o = X * inv_z, Y * inv_z, d * inv_z, torch.zeros_like(d)
    row_u = torch.stack((e, o, -a * e, -a * b, valid + a * a, -b), dim=-1) * fx
    row_v = torch.stack((o, e, -b * e, -valid - b * b, a * b, a), dim=-1) * fy
    J_j = torch.stack((row_u, row_v), dim=-2)
    J_i = -(J_j @ se3.adjoint(G)[:, None])  # J_i = -Ad(G_ij)^T J_j on columns
    tx, ty, tz = (c[:, None] for c in G[:, :3].unbind(-1))
    J_z = torch.stack((fx * inv_z * (tx - tz * a), fy * inv_z * (ty - tz * b)), dim=-1)
    shape = (n_edges, h, w)
    return J_i.view(*shape, 2, 6), J_j.view(*shape, 2, 6), J_z.view(*shape, 2)


def frame_distance(
    T_cw: Tensor,
    disps: Tensor,
    intrinsics: Tensor,
    ii: Tensor,
    jj: Tensor,
    beta: float,
    bidirectional: bool = True,
) -> Tensor:
    """How far the cells of frame i move on the way to frame j, [E], cells (REFERENCE 5.5).

    The weighted mean over cells of the flow length of the full motion (share `beta`) and of
    its translation alone (share 1 - beta); `FAR_DISTANCE` where less than three quarters of
    the weight passes the near test. `bidirectional` averages i -> j and j -> i.
    """
    if bidirectional:
        n_edges = ii.shape[0]
        both = frame_distance(
            T_cw, disps, intrinsics, torch.cat((ii, jj)), torch.cat((jj, ii)), beta, False
        )
        return 0.5 * (both[:n_edges] + both[n_edges:])
    h, w = disps.shape[-2:]
    G = relative_pose(T_cw, ii, jj)
    K, K_inv = _camera_matrices(intrinsics.to(disps.dtype))
    KR = K @ se3.rotation(G) @ K_inv
    Kt = G[:, :3] @ K.T
    pixels = _homogeneous(h, w, disps)
    flat = disps.flatten(1)
    out = torch.empty(ii.shape[0], dtype=disps.dtype, device=disps.device)
    step = max(1, (_CHUNK_CELLS_GPU if disps.is_cuda else _CHUNK_CELLS) // (h * w))
    for start in range(0, ii.shape[0], step):
        part = slice(start, min(start + step, ii.shape[0]))
        d = flat.index_select(0, ii[part])
        full = _transform(KR[part], Kt[part], pixels, d)
        f1, m1 = _masked_flow(full, pixels)
        shifted = torch.addcmul(pixels, Kt[part, :, None], d[:, None])
        f2, m2 = _masked_flow(shifted, pixels)
        share = (beta * m1 + (1.0 - beta) * m2) / (h * w)
        mean = (beta * f1 + (1.0 - beta) * f2) / (h * w) / share.clamp_min(_MIN_SHARE)
        out[part] = torch.where(share < _MIN_SHARE, torch.full_like(mean, FAR_DISTANCE), mean)
    return out


def _masked_flow(points: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Sum of the flow length over usable cells [E] and their number [E]; overwrites points."""
    uv, Z = points[:, :2], points[:, 2]
    usable = torch.gt(Z, NEAR, out=torch.empty_like(Z))
    uv *= Z.clamp_(min=NEAR).reciprocal_()[:, None]
    uv -= pixels[:2]
    uv *= uv
    length = torch.add(uv[:, 0], uv[:, 1], out=uv[:, 0]).sqrt_()
    return length.mul_(usable).sum(-1), usable.sum(-1)


def _camera_matrices(intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Camera matrix K [3, 3] and its inverse."""
    fx, fy, cx, cy = intrinsics.unbind()
    o, one = torch.zeros_like(fx), torch.ones_like(fx)
    K = torch.stack((fx, o, cx, o, fy, cy, o, o, one)).view(3, 3)
    K_inv = torch.stack((1 / fx, o, -cx / fx, o, 1 / fy, -cy / fy, o, o, one)).view(3, 3)
    return K, K_inv


def _homogeneous(h: int, w: int, like: Tensor) -> Tensor:
    """Cells [x, y, 1] as columns, [3, h*w]."""
    xy = pixel_grid(h, w, like.dtype, like.device).view(-1, 2).T
    return torch.cat((xy, torch.ones_like(xy[:1])))


def _transform(R: Tensor, t: Tensor, rays: Tensor, d: Tensor) -> Tensor:
    """R [E,3,3] rays [3,P] + d [E,P] t [E,3] for every edge, [E, 3, P]."""
    turned = (R.reshape(-1, 3) @ rays).view(R.shape[0], 3, rays.shape[1])
    return turned.addcmul_(t[:, :, None], d[:, None])
