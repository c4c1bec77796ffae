"""What is known of how a camera moves: steadily, as long as nothing measured says otherwise.

The motion between two keyframes that see little of what stands still is hardly measured, and least
of all its scale against the motions before and after it. A camera has inertia: its velocity, in the
world, and its rate of turning, in its own frame, change little in little time (white noise on
acceleration, as in continuous-time state estimation: Barfoot, State Estimation for Robotics, 2017,
section 3.4). How little is read from the path itself, so that one held in the hand may shake, and
velocities are compared by their ratio, so that no piece of a path gains by being smaller.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from droidw.geometry.se3 import inv, left_jacobian_inverse, log, mul, rotation
from droidw.solve.problem import PoseTerm

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["MEDIAN_SQUARE", "steady_motion"]

MEDIAN_SQUARE = 2.366
"""Median of the squared length of three numbers of variance 1."""

# Keyframes that tell what is usual.
_LEAST = 8
# Share of the usual speed below which a camera stands, and has no speed to compare another with.
_STANDS = 0.1
# Changes from one motion to the next that are usual at least: share of the speed, radians.
_LEAST_SHARE, _LEAST_TURN = 0.03, 0.002
# Times what is usual at which a change counts by half: where a camera sets off or stops.
_SUDDEN = 3.0


def steady_motion(T_cw: Tensor, times: Tensor, weight: float) -> PoseTerm | None:
    """The energy `weight * (c(|a|^2 / s_a^2) + c(|b|^2 / s_b^2))` over every three poses in a row.

    a is the change of velocity of the camera's centre as a share of its mean speed, b the change of
    its rotation vector per time, both over the root of the time from the middle of one motion to
    the middle of the next; s_a and s_b are what is usual in this path, by the median, and c is a
    Cauchy kernel. Linearised, but for the spreads and what the kernel leaves.

    A path that shrinks stands more often. That is no evidence: the part of the gradient that is a
    change of the scale of the whole is left out.

    Args:
        T_cw: [N,7] poses in the order of time, world to camera.
        times: [N] float64, strictly rising or falling.
        weight: in the units of the energy of `BAProblem`.
    Returns:
        None where there are too few poses to tell what is usual, or the camera stands most of the
        time, or times neither rise nor fall.
    """
    dt = (times[1:] - times[:-1]).to(T_cw.device, torch.float64)
    if len(T_cw) < _LEAST or not bool((dt * dt[0] > 0).all()):
        return None
    T = T_cw.double()
    root = (0.5 * (dt[1:] + dt[:-1]).abs()).sqrt()
    R, centres = rotation(T), inv(T)[:, :3]
    velocity = (centres[1:] - centres[:-1]) / dt[:, None]
    stands = _STANDS * velocity.norm(dim=1).median()
    if not bool(stands > 0):
        return None
    a, J_a = _velocity_changes(velocity, R, dt, stands)
    b, J_b = _turning_changes(T, dt)

    # A path that is steady to rounding must not become stiff.
    typical = root.median()
    least = _LEAST_SHARE / typical, _LEAST_TURN / (dt.abs().median() * typical)
    e, J = [], []
    for change, jacobian, floor in zip((a, b), (J_a, J_b), least, strict=True):
        change, jacobian = change / root[:, None], jacobian / root[:, None, None, None]
        usual = (change.square().sum(1).median() / MEDIAN_SQUARE).sqrt().clamp_min(floor)
        e.append(change / usual)
        J.append(jacobian / usual)
    square = torch.stack([part.square().sum(1) for part in e], dim=1) / 3.0
    kept = (1.0 / (1.0 + square / _SUDDEN**2)).repeat_interleave(3, dim=1)
    return _term(torch.cat(e, dim=1), torch.cat(J, dim=2), kept, weight, _growth(R, centres))


def _velocity_changes(
    velocity: Tensor, R: Tensor, dt: Tensor, stands: Tensor
) -> tuple[Tensor, Tensor]:
    """Changes [N-2,3] of velocity [N-1,3] as shares of the speed, and their Jacobians [N-2,3,3,6].

    Args:
        R: [N,3,3] world to camera. dt: [N-1].
        stands: speed, a scalar, that is added to the mean speed in squares.
    Returns:
        The second by (change, which of its three poses, component, tangent vector).
    """
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    square = mean.square().sum(1) + stands.square()
    speed = square.sqrt()[:, None]
    change = (velocity[1:] - velocity[:-1]) / speed
    # change and mean as sums over the three of a share times the centre
    first, last = 1 / dt[:-1], 1 / dt[1:]
    of_change = torch.stack((first, -first - last, last), dim=1) / speed
    of_mean = 0.5 * torch.stack((-first, first - last, last), dim=1)
    slower = change[:, :, None] * (mean / square[:, None])[:, None]
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    J = torch.zeros(len(change), 3, 3, 6, dtype=R.dtype, device=R.device)
    for k in range(3):
        moved = of_change[:, k, None, None] * eye - of_mean[:, k, None, None] * slower
        # the centre moves by -R^T of what is added to the translation
        J[:, k, :, :3] = -moved @ R[k : len(R) - 2 + k].transpose(1, 2)
    return change, J


def _turning_changes(T: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
    """Changes [N-2,3] of the rotation vector per time, and their Jacobians, as of velocities."""
    turns = mul(T[1:], inv(T[:-1]))
    phi = log(turns)[:, 3:]
    rate = phi / dt[:, None]
    bend = left_jacobian_inverse(phi) / dt[:, None, None]
    back = bend @ rotation(turns)
    J = torch.zeros(len(rate) - 1, 3, 3, 6, dtype=T.dtype, device=T.device)
    J[:, 0, :, 3:] = back[:-1]
    J[:, 1, :, 3:] = -bend[:-1] - back[1:]
    J[:, 2, :, 3:] = bend[1:]
    return rate[1:] - rate[:-1], J


def _growth(R: Tensor, centres: Tensor) -> Tensor:
    """Tangent vectors [N,6] by which a path grows around its first camera."""
    grown = torch.zeros(len(R), 6, dtype=R.dtype, device=R.device)
    grown[:, :3] = torch.einsum("nij,nj->ni", R, centres[:1] - centres)
    return grown


def _term(e: Tensor, J: Tensor, kept: Tensor, weight: float, without: Tensor) -> PoseTerm:
    """Normal equations of residuals that three poses in a row have a part in.

    Args:
        e, kept: [N-2,r] residuals and their weights. J: [N-2,3,r,6].
        without: [N,6] a direction that is left out of the gradient.
    """
    count = len(e) + 2
    band = torch.zeros(count, 3, 6, 6, dtype=J.dtype, device=J.device)
    rhs = torch.zeros(count, 6, dtype=J.dtype, device=J.device)
    for k in range(3):
        rows = slice(k, len(e) + k)
        rhs[rows] -= torch.einsum("nra,nr->na", J[:, k], kept * e)
        for m in range(k + 1):
            band[rows, m] += torch.einsum("nra,nr,nrb->nab", J[:, k], kept, J[:, k - m])
    tiny = torch.finfo(rhs.dtype).tiny
    rhs -= without * ((rhs * without).sum() / without.square().sum().clamp_min(tiny))
    return PoseTerm(weight * band, weight * rhs)
