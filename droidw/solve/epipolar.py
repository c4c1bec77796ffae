"""Camera motion from matched points alone, without any depth.

What dense matches and depths agree on may be wrong together: along a bare wall the motion of the
camera has a twin, in which the direction of motion and the normal of the wall change places
(Longuet-Higgins, The visual ambiguity of a moving plane, 1984), and lines on it can be matched to
what either predicts. The few points that are matched by their descriptors wherever they went know
better, if only as many unknowns are asked of them as they can tell: those of a steady motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from droidw.geometry.se3 import adjoint, chained, exp, identity, inv, log, mul, rotation, skew
from droidw.solve.problem import PoseTerm

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "PointMatches",
    "cost_of",
    "disagreement",
    "epipolar_distance",
    "epipolar_term",
    "led",
    "planar_twin",
    "steady_fit",
]

# Pixels from its epipolar line at which a match counts by half: twice what those of corners usually
# are at the true motion.
_FAR = 0.2
# How much of a change from one motion to the next counts as much as a match that far off: radians,
# share of the mean distance that the camera goes.
_TURN, _SHARE = 0.0044, 0.05
# Gauss-Newton steps at most; the share of the energy that a step has to gain for another one;
# damping at first, at least, and at which no step is looked for any more.
_STEPS, _GAIN = 25, 1e-4
_DAMPED, _LEAST, _STUCK = 1e-2, 1e-6, 1e6


@dataclass(frozen=True)
class PointMatches:
    """Points matched between keyframes.

    Attributes:
        ii, jj: [M] int64, the keyframes; ii < jj.
        here, there: [M,3] float64, rays through the point in either, (x, y, 1).
        focal: focal length in pixels, the scale from rays to distances.
    """

    ii: Tensor
    jj: Tensor
    here: Tensor
    there: Tensor
    focal: float

    def __len__(self) -> int:
        return len(self.ii)

    def within(self, first: int, last: int, gap: int) -> PointMatches:
        """Those between keyframes `first` to `last` at most `gap` apart, counted from `first`."""
        kept = (self.ii >= first) & (self.jj <= last) & (self.jj - self.ii <= gap)
        ii, jj = self.ii[kept] - first, self.jj[kept] - first
        return PointMatches(ii, jj, self.here[kept], self.there[kept], self.focal)

    def spread(self, values: Tensor, count: int) -> Tensor:
        """Values [M] of matches in equal parts on the intervals between `count` keyframes, [N-1].

        Interval k lies between keyframes k and k + 1.
        """
        share = values / (self.jj - self.ii)
        change = torch.zeros(count, dtype=share.dtype)
        change.index_add_(0, self.ii, share)
        change.index_add_(0, self.jj, -share)
        return change.cumsum(0)[:-1]


def epipolar_distance(T_ji: Tensor, here: Tensor, there: Tensor, focal: float) -> Tensor:
    """Signed distance of matches from the epipolar lines of a motion, [M] pixels.

    To first order the least by which both points have to move (Sampson 1982). The length of the
    motion does not matter.

    Args:
        T_ji: [M,7] from the first camera to the second. here, there: [M,3] rays (x, y, 1).
    """
    return _measured(T_ji, here, there, focal)[0]


def disagreement(T_cw: Tensor, matches: PointMatches) -> Tensor:
    """What each match costs at these poses, [M]; see `cost_of`."""
    T = T_cw.double()
    T_ji = mul(T[matches.jj], inv(T[matches.ii]))
    r = epipolar_distance(T_ji, matches.here, matches.there, matches.focal)
    return (r / _FAR).square().log1p()


def cost_of(pixels: float) -> float:
    """What a match costs so far from its epipolar line: log(1 + s^2), s in fifths of a pixel."""
    return math.log1p((pixels / _FAR) ** 2)


def epipolar_term(T_cw: Tensor, matches: PointMatches, weight: float) -> PoseTerm:
    """The energy `weight * sum log(1 + s^2)` of all matches (`disagreement`), linearised.

    Args:
        T_cw: [N,7] poses, world to camera. weight: in the units of the energy of `BAProblem`.
    """
    T = T_cw.double().to(matches.here.device)
    ii, jj = matches.ii, matches.jj
    T_ji, r, J_j = _judged(T, matches)
    kept = weight / (1.0 + r.square())
    # exp(w) on the right of T_ji is exp(Ad w) on its left
    J_i = -torch.einsum("ma,mab->mb", J_j, adjoint(T_ji))
    gap = jj - ii
    width = 1 + (int(gap.max()) if len(gap) else 0)
    band = torch.zeros(len(T) * width, 6, 6, dtype=T.dtype, device=T.device)
    rhs = torch.zeros(len(T), 6, dtype=T.dtype, device=T.device)
    for at, J in ((ii, J_i), (jj, J_j)):
        rhs.index_add_(0, at, -(kept * r)[:, None] * J)
        band.index_add_(0, at * width, kept[:, None, None] * J[:, :, None] * J[:, None])
    both = kept[:, None, None] * J_j[:, :, None] * J_i[:, None]
    band.index_add_(0, jj * width + gap, both)
    return PoseTerm(band.reshape(len(T), width, 6, 6), rhs).to(T_cw.device)


def planar_twin(motions: Tensor, planes: Tensor) -> Tensor:
    """Motions [N,7] that move a plane in the picture as these do, to first order.

    Direction of motion and normal of the plane change places, and what that adds to the turn is
    taken from it: with X' = R (1 + v m^T) X of points on the plane m^T X = 1, the twin has v and m
    the other way round, each as long as the other was, and R exp(m x v). Of its two signs it takes
    the one by which the plane is in front of the camera.

    Args:
        motions: [N,7] from each camera to the next.
        planes: [N,3] m, in the first camera of each: normal over distance.
    """
    R, t = rotation(motions), motions[:, :3]
    v = (R.mT @ t[..., None])[..., 0]
    long = v.norm(dim=1, keepdim=True) / planes.norm(dim=1, keepdim=True).clamp_min(1e-12)
    long = torch.where(v[:, 2:] < 0, -long, long)
    none = torch.zeros_like(v)
    turned = exp(torch.cat([none, torch.linalg.cross(planes, v)], dim=1))
    kept = torch.cat([none, motions[:, 3:]], dim=1)
    turn = mul(kept, turned)
    moved = (rotation(turn) @ (planes * long)[..., None])[..., 0]
    return torch.cat([moved, turn[:, 3:]], dim=1)


def steady_fit(motions: Tensor, matches: PointMatches) -> Tensor:
    """The steady motion that explains most of the matches, from where this one leads to.

    Minimises what matches cost (`disagreement`, a Cauchy kernel) and what changes from one motion
    to the next do, of the rotation and of the translation as a share of its usual length. Each
    motion stays as long as it was in the end: so few matches do not know better.

    Args:
        motions: [N-1,7] from each of N >= 3 keyframes to the next. matches: between them.
    Returns:
        [N-1,7] float64, such motions.
    """
    known = motions[:, :3].double().norm(dim=1, keepdim=True)
    motions = _as_long(motions.double())
    energy, damped = _energy(motions, matches), _DAMPED
    for _ in range(_STEPS):
        H, g = _normal_equations(motions, matches)
        before = energy
        while damped < _STUCK:
            diagonal = torch.diag(damped * (H.diagonal() + 1e-6))
            step = -torch.linalg.solve(H + diagonal, g).reshape(-1, 6)
            tried = _as_long(mul(exp(step), motions))
            energy = _energy(tried, matches)
            if energy < before:
                motions, damped = tried, max(damped / 5, _LEAST)
                break
            energy, damped = before, damped * 5
        if before - energy < _GAIN * before:
            break
    t = motions[:, :3]
    t = t * (known / t.norm(dim=1, keepdim=True).clamp_min(1e-12))
    return torch.cat([t, motions[:, 3:]], dim=1)


def _as_long(motions: Tensor) -> Tensor:
    """The same with translations that are one long on average."""
    t = motions[:, :3]
    return torch.cat([t / t.norm(dim=1).mean().clamp_min(1e-12), motions[:, 3:]], dim=1)


def led(motions: Tensor) -> Tensor:
    """Poses [N,7] that these motions lead through, from the identity on."""
    return chained(motions, identity(dtype=motions.dtype))


def _energy(motions: Tensor, matches: PointMatches) -> float:
    changes = _changes(motions)
    return float(disagreement(led(motions), matches).sum() + changes.square().sum())


def _changes(motions: Tensor) -> Tensor:
    """What changes from one motion to the next, weighed, [N-2,6]; translations first."""
    t, R = motions[:, :3], motions[:, 3:]
    still = torch.zeros_like(t)
    turns = torch.cat([still, R], dim=1)
    turned = log(mul(turns[1:], inv(turns[:-1])))[:, 3:]
    return torch.cat([(t[1:] - t[:-1]) / _SHARE, turned / _TURN], dim=1)


def _normal_equations(motions: Tensor, matches: PointMatches) -> tuple[Tensor, Tensor]:
    """Of tangent vectors of all motions, [6(N-1),6(N-1)] and [6(N-1)], Gauss-Newton."""
    count, poses = len(motions), led(motions)
    _, r, J = _judged(poses, matches)
    kept = 1.0 / (1.0 + r.square())
    # All matches between two keyframes see the motions in between alike.
    pairs, at = torch.unique(matches.ii * (count + 1) + matches.jj, return_inverse=True)
    ii, jj = pairs // (count + 1), pairs % (count + 1)
    H_pair = torch.zeros(len(pairs), 6, 6, dtype=r.dtype)
    H_pair.index_add_(0, at, (kept[:, None] * J)[:, :, None] * J[:, None])
    g_pair = torch.zeros(len(pairs), 6, dtype=r.dtype).index_add_(0, at, (kept * r)[:, None] * J)
    k = torch.arange(count)
    inside = (ii[:, None] <= k) & (k < jj[:, None])
    seen = adjoint(mul(poses[jj][:, None], inv(poses[1:])[None])) * inside[..., None, None]
    H = torch.einsum("pkab,pac,plcd->kbld", seen, H_pair, seen).reshape(6 * count, 6 * count)
    g = torch.einsum("pkab,pa->kb", seen, g_pair).reshape(-1)

    # The rotation from one motion to the next is small: its Jacobians are those of a difference.
    e, t = _changes(motions), motions[:, :3]
    moved = torch.zeros(count, 6, 6, dtype=r.dtype)
    moved[:, :3, :3] = torch.eye(3, dtype=r.dtype) / _SHARE
    moved[:, :3, 3:] = -skew(t) / _SHARE
    moved[:, 3:, 3:] = torch.eye(3, dtype=r.dtype) / _TURN
    steady = torch.zeros(count - 1, 6, count, 6, dtype=r.dtype)
    at = torch.arange(count - 1)
    steady[at, :, at] = -moved[:-1]
    steady[at, :, at + 1] = moved[1:]
    steady = steady.reshape(6 * (count - 1), 6 * count)
    return H + steady.T @ steady, g + steady.T @ e.reshape(-1)


def _judged(T: Tensor, matches: PointMatches) -> tuple[Tensor, Tensor, Tensor]:
    """Motions [M,7] between the poses T [N,7] of matches, and distances and Jacobians in _FAR."""
    T_ji = mul(T[matches.jj], inv(T[matches.ii]))
    r, J = _measured(T_ji, matches.here, matches.there, matches.focal)
    return T_ji, r / _FAR, J / _FAR


def _measured(T_ji: Tensor, a: Tensor, b: Tensor, focal: float) -> tuple[Tensor, Tensor]:
    """Distances [M] as of `epipolar_distance`, and by tangent vectors from the left, [M,6]."""
    R = rotation(T_ji)
    length = T_ji[:, :3].norm(dim=1, keepdim=True).clamp_min(1e-12)
    t = T_ji[:, :3] / length
    turned = (R @ a[..., None])[..., 0]
    # With E = [t] R, a tangent vector (v, w) adds [v] R + [w] E to E.
    line = torch.linalg.cross(t, turned)
    into = torch.linalg.cross(b, t)
    m = (R.mT @ into[..., None])[..., 0]
    n = (b * line).sum(1)
    square = (line[:, :2].square().sum(1) + m[:, :2].square().sum(1)).clamp_min(1e-18)
    root = square.sqrt()
    dn = torch.cat(
        [torch.linalg.cross(turned, b) / length, torch.linalg.cross(line, b)],
        dim=1,
    )
    dl = torch.cat([-skew(turned) / length[..., None], -skew(line)], dim=2)
    # E^T [w]^T b = [t R]^T (b x w)
    dm_v = R.mT @ skew(b) / length[..., None]
    dm_w = -(R.mT @ skew(t)) @ skew(b)
    dm = torch.cat([dm_v, dm_w], dim=2)
    half = (line[:, :2, None] * dl[:, :2]).sum(1) + (m[:, :2, None] * dm[:, :2]).sum(1)
    J = dn / root[:, None] - (n / (square * root))[:, None] * half
    return focal * n / root, focal * J
