"""The paths that the report draws: camera centres in the frame of the first camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from droidw.errors import DroidwError
from droidw.geometry.align import umeyama
from droidw.slam.frame import RunResult, Trajectory

__all__ = ["Paths", "make_paths", "rotation"]

Array = npt.NDArray[np.float64]
_MAX_DIFF = 0.02


@dataclass(frozen=True)
class Paths:
    """What the trajectory figures show, seen from the first camera: x right, y down, z forward.

    Attributes:
        times: [N] seconds; centres: [N,3] estimated camera centres.
        keyframe_times: [K]; keyframes: [K,3] centres of the keyframes.
        truth: [M,3] reference over the time of the run, laid on the estimate; None if unknown.
        error_times, errors: [M] stamps and position errors; empty without truth.
        unit: "m" with truth or a metric depth prior, "" where the scale is arbitrary.
        scale: factor from scene units to `unit`.
        depth: median depth of the scene in `unit`, or None.
        note: why there is no truth although the source has one, or "".
    """

    times: Array
    centres: Array
    keyframe_times: Array
    keyframes: Array
    truth: Array | None
    error_times: Array
    errors: Array
    unit: str
    scale: float
    depth: float | None
    note: str = ""

    @property
    def length(self) -> float:
        """Length of the estimated path in `unit`."""
        return float(np.linalg.norm(np.diff(self.centres, axis=0), axis=1).sum())

    def bar(self, length: float) -> str:
        """What is written at a scale bar of that length."""
        if self.unit:
            return f"{length:g} {self.unit}"
        share = f" ({100 * length / self.depth:.2g} % of depth)" if self.depth else ""
        return f"{length:g}, scale arbitrary{share}"


def make_paths(result: RunResult) -> Paths:
    """Lay the truth, if there is any, on the estimate and turn both to the first camera's frame."""
    times, poses = _finite(result.trajectory)
    keys = np.array([k.T_wc for k in result.keyframes], dtype=np.float64).reshape(-1, 7)
    key_times = np.array([k.time for k in result.keyframes], dtype=np.float64)
    good = np.isfinite(keys).all(axis=1)
    keys, key_times = keys[good], key_times[good]
    if not len(poses) and len(keys):
        times, poses = key_times, keys
    metric = str(result.manifest.get("scale", "")).startswith("metric")
    scale, unit, note = 1.0, "m" if metric else "", ""
    truth: Array | None = None
    error_times = errors = np.zeros(0)
    if result.truth is not None and len(poses):
        laid = _lay(times, poses[:, :3], result.truth)
        if isinstance(laid, str):
            note = laid
        else:
            scale, unit = laid.scale, "m"
            truth, error_times, errors = laid.truth, laid.times, laid.errors
    origin = poses[0, :3] if len(poses) else np.zeros(3)
    R_wc = rotation(poses[0, 3:]) if len(poses) else np.eye(3)

    def view(points: Array) -> Array:
        return np.asarray(scale * (points - origin) @ R_wc)

    depth = _median_depth(result)
    return Paths(
        times=times,
        centres=view(poses[:, :3]),
        keyframe_times=key_times,
        keyframes=view(keys[:, :3]),
        truth=None if truth is None else view(truth),
        error_times=error_times,
        errors=errors,
        unit=unit,
        scale=scale,
        depth=None if depth is None else depth * scale,
        note=note,
    )


@dataclass(frozen=True)
class _Laid:
    scale: float
    truth: Array
    times: Array
    errors: Array


def _lay(times: Array, centres: Array, reference: Trajectory) -> _Laid | str:
    """Bring the truth into the frame of the estimate, or say why that cannot be."""
    ref_times, ref_poses = _finite(reference)
    est, ref = _match(times, ref_times)
    if len(est) < 3:
        return "the truth cannot be shown: its time stamps do not match those of the run"
    source, target = centres[est], ref_poses[ref, :3]
    refused = "the truth cannot be shown: the camera moved too little to align the two paths"
    if min(float(np.ptp(source, axis=0).max()), float(np.ptp(target, axis=0).max())) < 1e-9:
        return refused
    try:
        found = umeyama(source, target, True)
    except (DroidwError, ValueError):
        return refused
    scale, R = float(found.scale), np.asarray(found.R, dtype=np.float64)
    t = np.asarray(found.t, dtype=np.float64)
    if not np.isfinite(scale) or scale <= 0:
        return refused
    errors = np.linalg.norm(scale * source @ R.T + t - target, axis=1)
    return _Laid(scale, (target - t) @ R / scale, ref_times[ref], errors)


def _match(est: Array, ref: Array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """For each estimated stamp the nearest of the truth, if it is near enough and not yet taken."""
    if not len(est) or not len(ref):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    right = np.clip(np.searchsorted(ref, est), 0, len(ref) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(est - ref[left]) <= np.abs(est - ref[right]), left, right)
    index = np.flatnonzero(np.abs(est - ref[nearest]) <= _MAX_DIFF)
    taken, first = np.unique(nearest[index], return_index=True)
    return index[first].astype(np.int64), taken.astype(np.int64)


def _finite(trajectory: Trajectory) -> tuple[Array, Array]:
    poses = np.asarray(trajectory.T_wc, dtype=np.float64).reshape(-1, 7)
    times = np.asarray(trajectory.times, dtype=np.float64)
    good = np.isfinite(poses).all(axis=1) & np.isfinite(times)
    order = np.argsort(times[good], kind="stable")
    return times[good][order], poses[good][order]


def _median_depth(result: RunResult) -> float | None:
    values = [
        k.disp[np.isfinite(k.disp) & (k.disp > 0)]
        for k in result.keyframes[:: max(1, len(result.keyframes) // 20)]
    ]
    values = [v for v in values if v.size]
    if not values:
        return None
    return float(1.0 / np.median(np.concatenate(values)))


def rotation(q: Array) -> Array:
    """Rotation matrix [3,3] of a quaternion xyzw [4]; the identity for one of no length."""
    norm = float(np.linalg.norm(q))
    if norm < 1e-12:
        return np.eye(3)
    x, y, z, w = (q / norm).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
