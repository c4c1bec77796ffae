"""What is known of how a camera moves: steadily, as long as nothing measured says otherwise.

The motion between two keyframes that see little of what stands still is hardly measured, and
least of all its scale against the motions before and after it. A camera has inertia: its velocity,
in the world, and its rate of turning, in its own frame, change little in little time (white noise on
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

__all__ = ["steady_motion"]

# Median of the squared length of three numbers of variance 1.
_MEDIAN = 2.366
# Keyframes that tell what is usual.
_LEAST = 8
# Share of the usual speed below which a camera stands, and has no speed to compare another with.
_STANDS = 0.1
# Changes from one motion to the next that are usual at least: share of the speed, radians.
_LEAST_CHANGE = (0.03, 0.002)
# Times what is usual at which a change counts by half: where a camera sets off or stops.
_SUDDEN = 3.0


def steady_motion(T_cw: Tensor, times: Tensor, weight: float) -> PoseTerm | None:
    """The energy `weight * (c(|a|^2 / s_a^2) + c(|b|^2 / s_b^2))`, summed over three poses in a row.

    a is the change of velocity of the camera's centre as a share of its mean speed, b the change of
    its rotation vector per time, both over the root of the time from the middle of one motion to the
    middle of the next; s_a and s_b are what is usual in this path, by the median, and c is a Cauchy
    kernel. Linearised, but for the spreads and what the kernel leaves.

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
    turns = mul(T[1:], inv(T[:-1]))

    velocity = (centres[1:] - centres[:-1]) / dt[:, None]
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    stands = _STANDS * velocity.norm(dim=1).median()
    if not bool(stands > 0):
        return None
    square = mean.square().sum(1) + stands.square()
    speed = square.sqrt()[:, None]
    a = (velocity[1:] - velocity[:-1]) / root[:, None] / speed
    # change and mean of velocity as sums over the three of a share times the centre
    first, last = 1 / dt[:-1], 1 / dt[1:]
    of_change = torch.stack((first, -first - last, last), dim=1) / root[:, None] / speed
    of_mean = 0.5 * torch.stack((-first, first - last, last), dim=1)
    slower = a[:, :, None] * (mean / square[:, None])[:, None]
    eye = torch.eye(3, dtype=torch.float64, device=T.device)
    J_a = torch.zeros(len(a), 3, 3, 6, dtype=torch.float64, device=T.device)
    for k in range(3):
        change = of_change[:, k, None, None] * eye - of_mean[:, k, None, None] * slower
        # the centre moves by -R^T of what is added to the translation
        J_a[:, k, :, :3] = -change @ R[k : len(R) - 2 + k].transpose(1, 2)

    phi = log(turns)[:, 3:]
    rate = phi / dt[:, None]
    b = (rate[1:] - rate[:-1]) / root[:, None]
    bend = left_jacobian_inverse(phi) / dt[:, None, None]
    back = bend @ rotation(turns)
    J_b = torch.zeros_like(J_a)
    J_b[:, 0, :, 3:] = back[:-1]
    J_b[:, 1, :, 3:] = -bend[:-1] - back[1:]
    J_b[:, 2, :, 3:] = bend[1:]
    J_b /= root[:, None, None, None]

    # A path that is steady to rounding must not become stiff.
    least = torch.stack((root.median(), (dt.abs() * root.median()).median()))
    least = torch.tensor(_LEAST_CHANGE, dtype=torch.float64, device=T.device) / least
    usual = [
        (e.square().sum(1).median() / _MEDIAN).clamp_min(floor**2)
        for e, floor in zip((a, b), least, strict=True)
    ]
    J = torch.cat([j / square.sqrt() for j, square in zip((J_a, J_b), usual, strict=True)], dim=2)
    e = torch.cat([v / square.sqrt() for v, square in zip((a, b), usual, strict=True)], dim=1)

    parts = e.view(-1, 2, 3).square().sum(2) / 3.0
    kept = (1.0 / (1.0 + parts / _SUDDEN**2)).repeat_interleave(3, dim=1)

    band = torch.zeros(len(T), 3, 6, 6, dtype=torch.float64, device=T.device)
    rhs = torch.zeros(len(T), 6, dtype=torch.float64, device=T.device)
    for k in range(3):
        rows = slice(k, len(T) - 2 + k)
        rhs[rows] -= torch.einsum("nra,nr->na", J[:, k], kept * e)
        for m in range(k + 1):
            band[rows, m] += torch.einsum("nra,nr,nrb->nab", J[:, k], kept, J[:, k - m])
    larger = torch.zeros_like(rhs)
    larger[:, :3] = torch.einsum("nij,nj->ni", R, centres[:1] - centres)
    rhs -= larger * ((rhs * larger).sum() / larger.square().sum().clamp_min(1e-300))
    return PoseTerm(weight * band, weight * rhs)
