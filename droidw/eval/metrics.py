"""ATE and RPE of a trajectory against a reference; pure functions in float64."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from droidw.errors import InputError, UsageError
from droidw.eval.associate import DEFAULT_MAX_DIFF, associate, uncrossed
from droidw.eval.relative import Delta, pairs, relative_errors
from droidw.geometry.align import umeyama
from droidw.slam.frame import Trajectory

__all__ = [
    "Align",
    "Delta",
    "Normalise",
    "Statistics",
    "TrajectoryScore",
    "path_length",
    "score",
]

Array = npt.NDArray[np.float64]
Align = Literal["sim3", "se3", "scale", "none"]
Normalise = Literal["none", "displacement", "path"]


@dataclass(frozen=True)
class Statistics:
    """Figures of a list of non-negative errors."""

    rmse: float
    mean: float
    median: float
    max: float
    std: float

    @classmethod
    def of(cls, errors: Array) -> Statistics | None:
        """Statistics of [M] errors, or None where there is none; std is that of the population."""
        if not len(errors):
            return None
        return cls(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            max=float(np.max(errors)),
            std=float(np.std(errors)),
        )


@dataclass(frozen=True)
class TrajectoryScore:
    """How far an estimated trajectory is from a reference, with all that the figures depend on.

    Attributes:
        estimate, reference: labels of what was compared, such as file names.
        align: the alignment applied to the estimate first.
        normalise: by what length of the reference all lengths were divided.
        unit: unit of all lengths: that of the reference, or that length.
        frames: usable poses of the estimate; matched: of these, with a pose of the reference.
        ref_frames: usable poses of the reference.
        skipped, ref_skipped: poses left out because a number in them was not finite.
        max_diff, worst_diff: largest time difference of a matched pair that was allowed, and that
            occurred, seconds.
        scale: factor that was applied to the estimate.
        path_length: length of the reference over the matched frames.
        path_length_est: the same of the estimate after alignment.
        time_covered: share of the reference's duration that the matched frames span.
        ate: absolute position errors.
        rpe_trans, rpe_rot: relative errors over `delta`, in `unit` and in degrees; None where no
            two matched frames are that far apart.
        rpe_pairs: number of pairs behind them.
        notes: sentences.
        times, errors: [M] stamps in seconds and position errors of the matched frames.
        rpe_times, rpe_errors: [P] stamps of the first frames of the pairs, and their errors in
            translation and in degrees, [P,2].
        aligned, truth: [M,3] camera centres, estimate after alignment and reference.
    """

    estimate: str
    reference: str
    align: Align
    normalise: Normalise
    unit: str
    frames: int
    matched: int
    ref_frames: int
    skipped: int
    ref_skipped: int
    max_diff: float
    worst_diff: float
    scale: float
    path_length: float
    path_length_est: float
    time_covered: float
    ate: Statistics
    delta: Delta
    rpe_trans: Statistics | None
    rpe_rot: Statistics | None
    rpe_pairs: int
    notes: tuple[str, ...]
    times: Array = field(repr=False, compare=False)
    errors: Array = field(repr=False, compare=False)
    aligned: Array = field(repr=False, compare=False)
    truth: Array = field(repr=False, compare=False)
    rpe_times: Array = field(repr=False, compare=False)
    rpe_errors: Array = field(repr=False, compare=False)

    @property
    def coverage(self) -> float:
        """Share of the estimate's poses that could be compared."""
        return self.matched / self.frames

    @property
    def ate_percent(self) -> float | None:
        """RMSE of the position errors in percent of the path, or None if nothing moved."""
        return 100.0 * self.ate.rmse / self.path_length if self.path_length > 0 else None

    def to_dict(self) -> dict[str, Any]:
        """A flat, JSON-able record: finite numbers, text, and None for what does not exist."""
        record: dict[str, Any] = {
            "estimate": self.estimate,
            "reference": self.reference,
            "align": self.align,
            "normalise": self.normalise,
            "unit": self.unit,
            "frames": self.frames,
            "matched": self.matched,
            "coverage": self.coverage,
            "time_covered": self.time_covered,
            "ref_frames": self.ref_frames,
            "skipped": self.skipped,
            "ref_skipped": self.ref_skipped,
            "max_diff": self.max_diff,
            "worst_diff": self.worst_diff,
            "scale": self.scale,
            "path_length": self.path_length,
            "path_length_est": self.path_length_est,
            "ate_percent": self.ate_percent,
            "rpe_delta": str(self.delta),
            "rpe_pairs": self.rpe_pairs,
            "notes": list(self.notes),
        }
        for name, stats in (
            ("ate", self.ate),
            ("rpe_trans", self.rpe_trans),
            ("rpe_rot_deg", self.rpe_rot),
        ):
            for figure in ("rmse", "mean", "median", "max", "std"):
                record[f"{name}_{figure}"] = None if stats is None else getattr(stats, figure)
        return record


def score(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    align: Align = "sim3",
    max_diff: float = DEFAULT_MAX_DIFF,
    offset: float = 0.0,
    delta: Delta | None = None,
    normalise: Normalise = "none",
    unit: str = "m",
    names: tuple[str, str] = ("estimate", "reference"),
) -> TrajectoryScore:
    """Compare an estimated trajectory with a reference (both camera to world).

    The estimate is aligned to the reference over the matched camera centres by Umeyama's method
    ("scale" applies its factor alone). ATE is the distance of matched centres. RPE compares the
    motion between every two matched frames that lie `delta` apart: its translation after
    alignment, and the angle between the two rotations, in degrees.

    Args:
        estimate, reference: what is compared.
        align: how the estimate is laid on the reference.
        max_diff, offset: as `associate` takes them, in seconds.
        delta: of RPE; metres are in the unit of the reference, or of what it is normalised to.
        normalise: divide all lengths by the distance between the first and the last pose of the
            reference ("displacement": the unit of the published DyCheck figures, REFERENCE 6.4)
            or by the length of its path ("path": what the paper says that unit is).
        unit: name of the unit of the reference, for display.
        names: labels of the two, for messages.
    Raises:
        UsageError: for an unknown alignment or normalisation.
        InputError: if stamps do not match or too few poses are usable.
    """
    if align not in get_args(Align):
        raise UsageError(f"'{align}' is no alignment", f"available: {', '.join(get_args(Align))}")
    if normalise not in get_args(Normalise):
        raise UsageError(
            f"'{normalise}' is no normalisation", f"available: {', '.join(get_args(Normalise))}"
        )
    delta = delta or Delta()
    notes: list[str] = []
    est, skipped = _usable(estimate, names[0], notes)
    ref, ref_skipped = _usable(reference, names[1], notes)
    length = _length(ref.T_wc[:, :3], normalise, names[1])
    minimum = 3 if align in ("sim3", "se3") else 2
    matches = associate(est.times, ref.times, max_diff, offset, minimum)
    keep = uncrossed(ref.times[matches.ref], matches.diff)
    diff, rows = matches.diff[keep], matches.ref[keep]
    if len(rows) < minimum:
        raise InputError(
            f"of {len(matches)} pairs of stamps, {len(matches) - len(rows)} cross others in time",
            f"{max_diff:g} s is more than the distance of stamps: give a smaller --t-max-diff",
        )
    poses, truth = est.T_wc[matches.est[keep]], ref.T_wc[rows]
    # Both, so that without a scale in the alignment they still compare.
    poses[:, :3] /= length
    truth[:, :3] /= length
    times = ref.times[rows]
    scale, R, t = _alignment(poses[:, :3], truth[:, :3], align, notes)
    aligned = scale * poses[:, :3] @ R.T + t
    errors = np.linalg.norm(aligned - truth[:, :3], axis=1)
    first, second = pairs(times, truth[:, :3], delta)
    rpe_trans, rpe_rot = relative_errors(poses, truth, scale, first, second)
    if len(matches) < len(est):
        notes.append(
            f"{len(est) - len(matches)} of {len(est)} poses have no reference within "
            f"{max_diff:g} s and are left out"
        )
    if len(rows) < len(matches):
        notes.append(
            f"{len(matches) - len(rows)} pairs of stamps cross others in time, and are left out: "
            f"{max_diff:g} s is more than the distance of stamps"
        )
    if not len(first):
        notes.append(f"no two matched frames lie {delta} apart: there is no RPE")
    duration = float(ref.times.max() - ref.times.min())
    return TrajectoryScore(
        estimate=names[0],
        reference=names[1],
        align=align,
        normalise=normalise,
        unit=unit if normalise == "none" else normalise,
        frames=len(est),
        matched=len(rows),
        ref_frames=len(ref),
        skipped=skipped,
        ref_skipped=ref_skipped,
        max_diff=max_diff,
        worst_diff=float(np.abs(diff).max()),
        scale=scale,
        path_length=path_length(truth[:, :3]),
        path_length_est=path_length(aligned),
        time_covered=float(times.max() - times.min()) / duration if duration > 0 else 1.0,
        ate=_statistics(errors),
        delta=delta,
        rpe_trans=Statistics.of(rpe_trans),
        rpe_rot=Statistics.of(rpe_rot),
        rpe_pairs=len(first),
        notes=tuple(notes),
        times=times,
        errors=errors,
        aligned=aligned,
        truth=truth[:, :3].copy(),
        rpe_times=times[first],
        rpe_errors=np.stack([rpe_trans, rpe_rot], axis=1),
    )


def path_length(centres: Array) -> float:
    """Sum of the distances between successive centres [N,3]."""
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())


def _length(centres: Array, normalise: Normalise, name: str) -> float:
    """The length [1 or unit of the reference] by which all others are divided."""
    if normalise == "none":
        return 1.0
    whole = path_length(centres)
    length = whole if normalise == "path" else float(np.linalg.norm(centres[-1] - centres[0]))
    if not length > 1e-6 * whole:
        what = "moves nowhere" if not whole > 0 else "ends where it begins"
        raise InputError(
            f"{name}: {what}, so that nothing can be divided by its {normalise}",
            "leave it as it is: --normalise none" + (" or --normalise path" if whole > 0 else ""),
        )
    return length


def _statistics(errors: Array) -> Statistics:
    stats = Statistics.of(errors)
    if stats is None:
        raise InputError("there is no pose to compare")
    return stats


def _usable(trajectory: Trajectory, name: str, notes: list[str]) -> tuple[Trajectory, int]:
    """The finite poses in time order, quaternions normalised, and how many were left out."""
    T_wc = np.asarray(trajectory.T_wc, dtype=np.float64).reshape(-1, 7)
    times = np.asarray(trajectory.times, dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(T_wc[:, 3:], axis=1)
        good = np.isfinite(T_wc).all(axis=1) & np.isfinite(times) & (length > 1e-9)
        good &= np.isfinite(length)
    skipped = int((~good).sum())
    if not good.any():
        what = "holds no pose" if not len(times) else f"holds no finite pose in {len(times)} lines"
        raise InputError(f"{name}: {what}", "expected a pose a line: t tx ty tz qx qy qz qw")
    if skipped:
        notes.append(f"{name}: {skipped} of {len(times)} poses are not finite and are left out")
    times, T_wc = times[good], T_wc[good].copy()
    T_wc[:, 3:] /= length[good, None]
    order = np.argsort(times, kind="stable")
    return Trajectory(times[order], T_wc[order]), skipped


def _alignment(
    est: Array, truth: Array, align: Align, notes: list[str]
) -> tuple[float, Array, Array]:
    """Scale, rotation and translation for the estimate; what is undetermined goes to the notes."""
    if align == "none":
        return 1.0, np.eye(3), np.zeros(3)
    found = umeyama(est, truth, align != "se3")
    if found.note:
        notes.append(f"alignment: {found.note}")
    if align == "scale":
        return float(found.scale), np.eye(3), np.zeros(3)
    scale = float(found.scale) if align == "sim3" else 1.0
    return scale, np.asarray(found.R, dtype=np.float64), np.asarray(found.t, dtype=np.float64)
