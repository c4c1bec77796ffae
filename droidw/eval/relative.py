"""Relative pose errors (RPE): which pairs of poses, and how far their motions are apart."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from droidw.errors import UsageError

__all__ = ["Delta", "pairs", "relative_errors"]

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_TOLERANCE = 0.1
"""Share of a time or way by which a pair may miss it."""

_UNITS: dict[str, Literal["frames", "seconds", "metres"]] = {
    "": "frames",
    "s": "seconds",
    "m": "metres",
}


@dataclass(frozen=True)
class Delta:
    """How far apart the two poses of a relative error are.

    A count of frames, seconds, or metres of the way that the reference went (in its own unit).
    """

    value: float = 1.0
    unit: Literal["frames", "seconds", "metres"] = "frames"

    @classmethod
    def parse(cls, text: str) -> Delta:
        """Read "10" as ten frames, "0.5s" as half a second and "0.2m" as 0.2 metres.

        Raises:
            UsageError: if the text is none of these.
        """
        match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([sm]?)\s*", text)
        if match and float(match[1]) > 0:
            unit = _UNITS[match[2]]
            if unit != "frames" or float(match[1]).is_integer():
                return cls(float(match[1]), unit)
        raise UsageError(
            f"--delta: '{text}' is neither a whole number of frames nor a time or a length",
            "for example --delta 10 (frames), --delta 0.5s (seconds) or --delta 0.2m (metres)",
        )

    def __str__(self) -> str:
        if self.unit == "frames":
            return f"{self.value:g} frame" + ("" if self.value == 1 else "s")
        return f"{self.value:g} {self.unit[0]}"


def pairs(times: Array, centres: Array, delta: Delta) -> tuple[Index, Index]:
    """Every frame and the one `delta` later.

    In seconds and metres that is the nearest one, and only within a tenth of `delta`.

    Args:
        times: [M] seconds, rising. centres: [M,3] of the reference.
    Returns:
        [P] first and [P] second of each pair.
    """
    count = len(times)
    if delta.unit == "frames":
        step = int(delta.value)
        start = np.arange(max(count - step, 0), dtype=np.int64)
        return start, start + step
    if delta.unit == "seconds":
        along = times
    else:
        steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
    first = np.arange(count, dtype=np.int64)
    goal = along + delta.value
    right = np.clip(np.searchsorted(along, goal), 0, count - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(goal - along[left] <= along[right] - goal, left, right)
    # Where the camera stood still, the first of the frames at that place.
    nearest = np.maximum(np.searchsorted(along, along[nearest]), np.minimum(first + 1, count - 1))
    good = np.abs(along[nearest] - goal) <= _TOLERANCE * delta.value
    good &= nearest > first
    return first[good], nearest[good].astype(np.int64)


def relative_errors(
    est: Array, truth: Array, scale: float, first: Index, second: Index
) -> tuple[Array, Array]:
    """Errors of the motion between the poses of each pair.

    Args:
        est, truth: [M,7] camera to world, translation and unit quaternion xyzw.
        scale: factor on the translations of the estimate.
        first, second: [P] rows.
    Returns:
        [P] distance of the translations, in the unit of the truth, and [P] angle between the
        rotations in degrees.
    """
    R_est, R_ref = _rotations(est[:, 3:]), _rotations(truth[:, 3:])
    # Motion seen from the first of the two cameras: R_1^T R_2 and R_1^T (c_2 - c_1).
    turn_est = R_est[first].transpose(0, 2, 1) @ R_est[second]
    turn_ref = R_ref[first].transpose(0, 2, 1) @ R_ref[second]
    step_est = scale * _rotate_back(R_est[first], est[second, :3] - est[first, :3])
    step_ref = _rotate_back(R_ref[first], truth[second, :3] - truth[first, :3])
    error = turn_ref.transpose(0, 2, 1) @ turn_est
    # atan2 of sine and cosine keeps its digits at small angles, where acos of the trace does not.
    axis = np.stack(
        [
            error[:, 2, 1] - error[:, 1, 2],
            error[:, 0, 2] - error[:, 2, 0],
            error[:, 1, 0] - error[:, 0, 1],
        ],
        axis=1,
    )
    angle = np.arctan2(np.linalg.norm(axis, axis=1), np.trace(error, axis1=1, axis2=2) - 1.0)
    return np.linalg.norm(step_est - step_ref, axis=1), np.degrees(angle)


def _rotate_back(R: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("nji,nj->ni", R, vectors))


def _rotations(q: Array) -> Array:
    """Rotation matrices [N,3,3] of unit quaternions xyzw [N,4]."""
    x, y, z, w = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
