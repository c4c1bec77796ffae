"""Frames between keyframes, drawn to how steadily the camera moves.

A keyframe hangs on ten others, a frame on the four around it, and where the camera moves along its
axis most of a frame's error is its own. A camera has inertia: white noise on jerk (Tang, Yoon and
Barfoot, A White-Noise-On-Jerk Motion Prior for Continuous-Time Trajectory Estimation on SE(3), RA-L
2019). How exact frames are, and how much the camera shakes, is read from the path itself: fifth
differences are nearly all error, and third ones what the camera does besides. Keyframes stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from droidw.geometry.se3 import exp, from_matrix, inv, log, mul, rotation
from droidw.solve.motion import MEDIAN_SQUARE

__all__ = ["smoothed"]

Array = npt.NDArray[np.float64]

# Differences that tell how much the camera shakes, and how exact frames are.
_SHAKES, _ERROR = 3, 5
# Differences that are needed to tell.
_LEAST = 20
# What the camera does is this share of the variance of third differences at least.
_LEAST_SHARE = 0.05
# Times the usual at which an error, or a jerk, counts by half: a frame that went astray, a camera
# that sets off or stops.
_ASTRAY, _SUDDEN = 10.0, 2.0
# Steps in time that differ by more than this factor from the usual are gaps.
_GAP = 1.5
_ROUNDS = 10
_TOLERANCE, _MOST_STEPS = 1e-6, 200


def smoothed(T_cw: Tensor, times: Sequence[float], held: npt.NDArray[np.bool_]) -> Tensor:
    """Poses of which those that are not held are drawn to a steady motion.

    Positions of the camera, and how it is turned, are smoothed each by itself. Nothing is drawn
    across gaps in time, nor where too few frames follow one another to tell what is usual.

    Args:
        T_cw: [N,7] float64, world to camera, in the order of time.
        times: [N] seconds. held: [N], keyframes.
    Returns:
        [N,7]; held ones are the same to the byte.
    """
    stamps = np.asarray(times, dtype=np.float64)
    if held.all() or len(stamps) <= _LEAST + _ERROR or not (np.diff(stamps) > 0).all():
        return T_cw
    T = T_cw.cpu().double()
    centres = inv(T)[:, :3].numpy()
    rates = log(mul(T[1:], inv(T[:-1])))[:, 3:].numpy()
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(rates, axis=0)])
    moved = [_drawn(path, stamps, held) - path for path in (centres, turned)]
    if not np.any(moved):
        return T_cw
    turn = torch.nn.functional.pad(torch.from_numpy(moved[1]), (3, 0))
    R = rotation(exp(turn)) @ rotation(T)
    place = torch.from_numpy(centres + moved[0])
    found = from_matrix(torch.cat([R, -R @ place[:, :, None]], dim=2)).to(T_cw)
    return torch.where(torch.from_numpy(held).to(T_cw.device)[:, None], T_cw, found)


@dataclass(frozen=True)
class _Differences:
    """Divided differences of one order, as of errors of variance 1.

    Attributes:
        share: [M,order+1] of each of the points in a row; zeros across gaps.
    """

    share: Array

    @classmethod
    def of(cls, stamps: Array, order: int) -> _Differences:
        rows = np.lib.stride_tricks.sliding_window_view(stamps, order + 1)
        apart = rows[:, :, None] - rows[:, None, :]
        apart[:, np.arange(order + 1), np.arange(order + 1)] = 1.0
        share = 1.0 / (apart / np.median(np.diff(stamps))).prod(axis=2)
        share /= np.linalg.norm(share, axis=1, keepdims=True)
        step = np.diff(rows, axis=1) / np.median(np.diff(stamps))
        share[((step > _GAP) | (step < 1.0 / _GAP)).any(axis=1)] = 0.0
        return cls(share)

    def __call__(self, path: Array) -> Array:
        """[M,3] of a path [N,3]."""
        count, width = self.share.shape
        found = np.zeros((count, path.shape[1]))
        for k in range(width):
            found += self.share[:, k, None] * path[k : k + count]
        return found

    def back(self, rows: Array) -> Array:
        """The transpose: [N,3] of [M,3]."""
        count, width = self.share.shape
        path = np.zeros((count + width - 1, rows.shape[1]))
        for k in range(width):
            path[k : k + count] += self.share[:, k, None] * rows
        return path

    def usual(self, path: Array) -> float:
        """Variance of one component of a point, were it all error; NaN where too few tell."""
        known = self.share.any(axis=1)
        if known.sum() < _LEAST:
            return float("nan")
        return float(np.median(np.square(self(path)[known]).sum(axis=1))) / MEDIAN_SQUARE


def _drawn(path: Array, stamps: Array, held: npt.NDArray[np.bool_]) -> Array:
    """The path [N,3] that is likeliest, by errors and jerk that are usual in it."""
    jerk = _Differences.of(stamps, _SHAKES)
    error = _Differences.of(stamps, _ERROR).usual(path)
    shakes = jerk.usual(path)
    if not (np.isfinite(error) and np.isfinite(shakes) and error > 0):
        return path
    shakes = max(shakes - error, _LEAST_SHARE * shakes)
    free = (~held[:, None]).astype(np.float64)
    found, kept = path, np.ones((len(jerk.share), 1))
    counts = np.ones((len(path), 1))
    for _ in range(_ROUNDS):
        found = _solved(path, found, counts / error, kept / shakes, jerk, free)
        counts = _kept(found - path, error * _ASTRAY**2)
        kept = _kept(jerk(found), shakes * _SUDDEN**2)
    return found


def _kept(values: Array, variance: float) -> Array:
    """Weights [n,1] of values [n,3] by a Cauchy kernel; those of so much variance count by half."""
    square = np.square(values).sum(axis=1, keepdims=True)
    kept: Array = 1.0 / (1.0 + square / (3.0 * variance))
    return kept


def _solved(
    path: Array, start: Array, counts: Array, kept: Array, jerk: _Differences, free: Array
) -> Array:
    """Least squares of `counts` x errors and `kept` x jerk, by conjugate gradients.

    Args:
        path: [N,3] as measured. start: [N,3], of which those that are not free stay.
        counts: [N,1]. kept: [M,1]. free: [N,1], 1 or 0.
    """

    def times(x: Array) -> Array:
        product: Array = free * (counts * x + jerk.back(kept * jerk(x)))
        return product

    x: Array = start.copy()
    left = free * (counts * (path - x) - jerk.back(kept * jerk(x)))
    way, size = left, np.square(left).sum(axis=0)
    enough = _TOLERANCE**2 * np.maximum(size, np.finfo(np.float64).tiny)
    for _ in range(_MOST_STEPS):
        if (size <= enough).all():
            break
        ahead = times(way)
        along = size / np.maximum((way * ahead).sum(axis=0), np.finfo(np.float64).tiny)
        x += along * way
        left = left - along * ahead
        before, size = size, np.square(left).sum(axis=0)
        way = left + size / np.maximum(before, np.finfo(np.float64).tiny) * way
    return x
