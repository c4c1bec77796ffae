"""Rigid motions as batched tensors of seven numbers: translation, then unit quaternion xyzw.

Every function takes leading batch dimensions that broadcast, any floating dtype and any device,
and is differentiable (also at the identity). Tangent vectors are xi = (tau, phi), translation
first, and updates multiply from the left: `retract(T, xi) = exp(xi) * T` (REFERENCE 2.1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "act",
    "adjoint",
    "chained",
    "exp",
    "from_matrix",
    "identity",
    "inv",
    "left_jacobian_inverse",
    "log",
    "matrix",
    "mul",
    "normalise",
    "retract",
    "rotation",
    "skew",
]

# Below this squared angle the power series are used: there they are exact to float64 rounding,
# and above it the closed forms lose at most one digit to cancellation.
_SERIES_BELOW = 0.25
# (theta - sin theta) / theta^3 = sum (-1)^k theta^2k / (2k+3)!
_C_SERIES = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800)
# (1 - theta/2 cot(theta/2)) / theta^2, from the Bernoulli numbers.
_D_SERIES = (
    1 / 12,
    1 / 720,
    1 / 30240,
    1 / 1209600,
    1 / 47900160,
    691 / 1307674368000,
    1 / 74724249600,
)


def identity(
    *batch: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Tensor:
    """Identity motions, [*batch, 7]."""
    T = torch.zeros(*batch, 7, dtype=dtype, device=device)
    T[..., 6] = 1.0
    return T


def exp(xi: Tensor) -> Tensor:
    """Motion [..., 7] of a tangent vector [..., 6]: t = V(phi) tau, q from half the angle."""
    tau, phi = xi[..., :3], xi[..., 3:]
    theta2 = (phi * phi).sum(-1, keepdim=True)
    small = theta2 < _SERIES_BELOW
    theta = torch.where(small, torch.ones_like(theta2), theta2).sqrt()
    half = 0.5 * theta
    # sin(theta/2)/theta does not cancel, yet has no value (nor gradient) where theta is 0
    s = torch.where(small, _half_sinc(theta2), half.sin() / theta)
    w = torch.where(small, _half_cos(theta2), half.cos())
    b = 2.0 * s * s  # (1 - cos theta) / theta^2
    c = torch.where(small, _poly(theta2, _C_SERIES), (theta - theta.sin()) / theta**3)
    cross = torch.linalg.cross(phi, tau, dim=-1)
    t = tau + b * cross + c * torch.linalg.cross(phi, cross, dim=-1)
    return torch.cat((t, s * phi, w), dim=-1)


def log(T: Tensor) -> Tensor:
    """Tangent vector [..., 6] of a motion [..., 7], rotation angle in [0, pi]."""
    t, q = T[..., :3], T[..., 3:]
    q = torch.where(q[..., 3:] < 0, -q, q)  # q and -q are one rotation: take the shorter way
    v, w = q[..., :3], q[..., 3:]
    n2 = (v * v).sum(-1, keepdim=True)
    tiny = n2 < 1e-10
    n = torch.where(tiny, torch.ones_like(n2), n2).sqrt()
    w_safe = torch.where(tiny, w, torch.ones_like(w))
    near = 2.0 / w_safe * (1.0 - n2 / (3.0 * w_safe * w_safe))
    phi = v * torch.where(tiny, near, 2.0 * torch.atan2(n, w) / n)
    cross = torch.linalg.cross(phi, t, dim=-1)
    tau = t - 0.5 * cross + _bend(phi) * torch.linalg.cross(phi, cross, dim=-1)
    return torch.cat((tau, phi), dim=-1)


def left_jacobian_inverse(phi: Tensor) -> Tensor:
    """Change [..., 3, 3] of the rotation vector phi [..., 3] of exp(phi) by a turn from the left.

    `log(exp(d) exp(phi)) = phi + J d` to first order in d.
    """
    K = skew(phi)
    eye = torch.eye(3, dtype=phi.dtype, device=phi.device)
    return eye - 0.5 * K + _bend(phi)[..., None] * (K @ K)


def mul(A: Tensor, B: Tensor) -> Tensor:
    """Composition A * B, [..., 7]: B is applied first. The quaternion is not renormalised."""
    if A.shape != B.shape:
        shape = _joint_shape(A.shape[:-1], B.shape[:-1])
        A, B = A.expand(*shape, 7), B.expand(*shape, 7)
    t = A[..., :3] + _rotate(A[..., 3:], B[..., :3])
    return torch.cat((t, _quat_mul(A[..., 3:], B[..., 3:])), dim=-1)


def chained(motions: Tensor, first: Tensor) -> Tensor:
    """Poses [N,7] that motions [N-1,7], each applied to the pose before, lead to from `first`."""
    poses = [first]
    for motion in motions:
        poses.append(mul(motion, poses[-1]))
    return torch.stack(poses)


def inv(T: Tensor) -> Tensor:
    """Inverse motion, [..., 7]."""
    q = torch.cat((-T[..., 3:6], T[..., 6:]), dim=-1)
    return torch.cat((-_rotate(q, T[..., :3]), q), dim=-1)


def act(T: Tensor, X: Tensor) -> Tensor:
    """Points X [..., 3] moved by T [..., 7]; leading dimensions broadcast."""
    shape = _joint_shape(T.shape[:-1], X.shape[:-1])
    q = T[..., 3:].expand(*shape, 4)
    return _rotate(q, X.expand(*shape, 3)) + T[..., :3]


def adjoint(T: Tensor) -> Tensor:
    """Adjoint [..., 6, 6] with T exp(xi) = exp(Ad xi) T: [[R, [t]x R], [0, R]]."""
    R = rotation(T)
    top = torch.cat((R, skew(T[..., :3]) @ R), dim=-1)
    return torch.cat((top, torch.cat((torch.zeros_like(R), R), dim=-1)), dim=-2)


def rotation(T: Tensor) -> Tensor:
    """Rotation matrix [..., 3, 3] of a motion [..., 7] with unit quaternion."""
    x, y, z, w = T[..., 3:].unbind(-1)
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    rows = (
        1 - (yy + zz), xy - wz, xz + wy,
        xy + wz, 1 - (xx + zz), yz - wx,
        xz - wy, yz + wx, 1 - (xx + yy),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).view(*x.shape, 3, 3)


def matrix(T: Tensor) -> Tensor:
    """Homogeneous matrix [..., 4, 4] of a motion [..., 7]."""
    top = torch.cat((rotation(T), T[..., :3, None]), dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat((top, bottom), dim=-2)


def from_matrix(M: Tensor) -> Tensor:
    """Motion [..., 7] of a matrix [..., 4, 4] or [..., 3, 4] whose block R is a rotation.

    Takes the largest of the four quaternion components as pivot, so it is exact to rounding
    for every angle; w is made non-negative.
    """
    m = M[..., :3, :3]
    m00, m01, m02 = m[..., 0, 0], m[..., 0, 1], m[..., 0, 2]
    m10, m11, m12 = m[..., 1, 0], m[..., 1, 1], m[..., 1, 2]
    m20, m21, m22 = m[..., 2, 0], m[..., 2, 1], m[..., 2, 2]
    xw, yw, zw = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m20 + m02, m21 + m12
    outer = torch.stack(
        (
            1 + m00 - m11 - m22, xy, xz, xw,
            xy, 1 - m00 + m11 - m22, yz, yw,
            xz, yz, 1 - m00 - m11 + m22, zw,
            xw, yw, zw, 1 + m00 + m11 + m22,
        ),
        dim=-1,
    ).view(*m00.shape, 4, 4)  # 4 q q^T  # fmt: skip
    pivot = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*M.shape[:-2], 1, 4)
    q = outer.gather(-2, pivot).squeeze(-2)
    q = torch.where(q[..., 3:] < 0, -q, q)
    return normalise(torch.cat((M[..., :3, 3], q), dim=-1))


def normalise(T: Tensor) -> Tensor:
    """The same motion with a quaternion of length one, [..., 7]."""
    q = T[..., 3:]
    return torch.cat((T[..., :3], q / q.norm(dim=-1, keepdim=True)), dim=-1)


def retract(T: Tensor, xi: Tensor) -> Tensor:
    """Update exp(xi) * T with a renormalised quaternion, [..., 7] (left retraction)."""
    return normalise(mul(exp(xi), T))


def skew(v: Tensor) -> Tensor:
    """Cross-product matrix [..., 3, 3] of vectors [..., 3]."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), dim=-1).view(*x.shape, 3, 3)


def _joint_shape(a: torch.Size, b: torch.Size) -> torch.Size:
    """Shape that two leading shapes broadcast to."""
    # torch.broadcast_shapes would do, but its first call imports sympy: 0.7 s.
    return torch.Size(np.broadcast_shapes(tuple(a), tuple(b)))


def _bend(phi: Tensor) -> Tensor:
    """(1 - theta/2 cot(theta/2)) / theta^2 of rotation vectors [..., 3], [..., 1]."""
    theta2 = (phi * phi).sum(-1, keepdim=True)
    small = theta2 < _SERIES_BELOW
    safe = torch.where(small, torch.ones_like(theta2), theta2)
    half = 0.5 * safe.sqrt()
    return torch.where(small, _poly(theta2, _D_SERIES), (1.0 - half / half.tan()) / safe)


def _poly(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Polynomial of x with the constant first, by Horner."""
    out = torch.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        out = out * x + c
    return out


def _half_sinc(theta2: Tensor) -> Tensor:
    """sin(theta/2)/theta as a series in theta^2, for theta^2 below `_SERIES_BELOW`."""
    x = 0.25 * theta2
    return _poly(x, (1 / 2, -1 / 12, 1 / 240, -1 / 10080, 1 / 725760, -1 / 79833600))


def _half_cos(theta2: Tensor) -> Tensor:
    """cos(theta/2) as a series in theta^2, for theta^2 below `_SERIES_BELOW`."""
    x = 0.25 * theta2
    return _poly(x, (1.0, -1 / 2, 1 / 24, -1 / 720, 1 / 40320, -1 / 3628800))


def _rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors [..., 3] rotated by quaternions [..., 4] of the same leading shape."""
    axis, w = q[..., :3], q[..., 3:]
    u = torch.linalg.cross(axis + axis, v, dim=-1)
    rotated: Tensor = v + w * u + torch.linalg.cross(axis, u, dim=-1)
    return rotated


def _quat_mul(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product of quaternions xyzw, [..., 4]."""
    pv, pw, qv, qw = p[..., :3], p[..., 3:], q[..., :3], q[..., 3:]
    v = pw * qv + qw * pv + torch.linalg.cross(pv, qv, dim=-1)
    return torch.cat((v, pw * qw - (pv * qv).sum(-1, keepdim=True)), dim=-1)
