"""Alignment of two point sets by a similarity, the first step of every trajectory score."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from droidw.errors import InputError

__all__ = ["Sim3", "umeyama"]

# Singular values below this share of the largest count as zero.
_RANK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Sim3:
    """Similarity X -> scale * R X + t.

    Attributes:
        scale: positive.
        R: [3,3] rotation, determinant +1.
        t: [3] in the unit of the target.
        note: empty, or a sentence on what the points left undetermined.
    """

    scale: float
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    note: str = ""

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Moves points [N,3]."""
        moved: NDArray[np.float64] = self.scale * np.asarray(points) @ self.R.T + self.t
        return moved


def umeyama(
    source: NDArray[np.float64], target: NDArray[np.float64], with_scale: bool = True
) -> Sim3:
    """Similarity (or rigid motion) that brings source [N,3] closest to target [N,3].

    Least squares in closed form (Umeyama, PAMI 1991). The rotation is never a reflection.
    Where the points leave something free, the smallest choice is made and said in `note`:
    points on a line leave the turn about it, coincident points rotation and scale.

    Raises:
        InputError: shapes that differ or are not [N,3], no points, values that are not finite.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise InputError(
            f"alignment needs two point lists of one shape [N,3], got {list(source.shape)} "
            f"and {list(target.shape)}."
        )
    if len(source) == 0:
        raise InputError("alignment needs at least one pair of points, got none.")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise InputError("alignment got coordinates that are not finite (NaN or inf).")
    mean_source, mean_target = source.mean(0), target.mean(0)
    a, b = source - mean_source, target - mean_target
    variance = float((a * a).sum()) / len(a)
    spread = np.linalg.svd(a, compute_uv=False)
    covariance = b.T @ a / len(a)
    U, D, Vt = np.linalg.svd(covariance)
    # Umeyama's rank test on the covariance; rounding keeps coincident points from exact zeros
    size = max(float(np.abs(source).max()), float(np.abs(target).max()), 1e-300)
    least = max(_RANK_TOLERANCE * float(D[0]), (1e-12 * size) ** 2)
    rank = int(np.count_nonzero(least < D))
    if rank == 0:
        note = "all points of one side coincide: rotation and scale cannot be told and were kept."
        return Sim3(1.0, np.eye(3), mean_target - mean_source, note)
    note = ""
    if rank == 1:
        note = "the points lie on a line: the turn about it cannot be told and was kept smallest."
        R = _shortest_turn(Vt[0], U[:, 0])
        gain = float(D[0])
    else:
        flip = np.ones(3)
        if np.linalg.det(U) * np.linalg.det(Vt) < 0:
            flip[2] = -1.0
        R = (U * flip) @ Vt
        gain = float((D * flip).sum())
    scale = gain / variance if with_scale else 1.0
    if not (scale > 0.0 and spread[0] > 0.0):
        note = "the points of the two sides do not move together: scale cannot be told, kept at 1."
        scale = 1.0
    return Sim3(scale, R, mean_target - scale * R @ mean_source, note)


def _shortest_turn(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation by the smallest angle that takes the unit vector a to the unit vector b."""
    v, c = np.cross(a, b), float(a @ b)
    if c < -1.0 + 1e-12:  # half a turn, about any axis across a
        axis = np.cross(a, np.eye(3)[int(np.abs(a).argmin())])
        axis /= np.linalg.norm(axis)
        turn: NDArray[np.float64] = 2.0 * np.outer(axis, axis) - np.eye(3)
        return turn
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    turn = np.eye(3) + K + K @ K / (1.0 + c)
    return turn
