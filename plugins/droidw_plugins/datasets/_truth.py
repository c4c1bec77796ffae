"""Ground truth of sequences: read, corrected, and laid beside the pictures by time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from droidw.errors import InputError
from droidw.io.files import read_text
from droidw.io.listing import Entry
from droidw.io.rising import rising
from droidw.io.tum import read_tum
from droidw.slam.frame import Trajectory

__all__ = ["at_pictures", "from_matrices", "near_pictures", "read_positions", "read_truth"]

Matrices = npt.NDArray[np.float64]


def read_truth(path: Path, problems: list[str]) -> Trajectory | None:
    """Ground truth if there is a usable one; it is only scored, so that no fault is fatal."""
    if not path.is_file():
        return None
    try:
        return read_tum(path, problems=problems)
    except InputError as error:
        problems.append(f"{error.message}; the run is not scored")
        return None


def read_positions(path: Path, problems: list[str]) -> Trajectory | None:
    """The same for a file that may have positions alone, `t x y z`, as satellite receivers give.

    Orientation is then the identity, and a sentence says that it means nothing.
    """
    if not path.is_file():
        return None
    rows = [
        line.split("#", 1)[0].replace(",", " ").split()
        for line in read_text(path, "a trajectory").splitlines()
    ]
    rows = [row for row in rows if row]
    if not rows or any(len(row) != 4 for row in rows):
        return read_truth(path, problems)
    try:
        values = np.array(rows, dtype=np.float64)
    except ValueError:
        problems.append(f"{path.name} has a row that is no numbers; the run is not scored")
        return None
    values = values[np.isfinite(values).all(1)]
    values = values[rising(values[:, 0].tolist())]  # one stray time costs no other
    if not len(values):
        problems.append(f"{path.name} holds no position; the run is not scored")
        return None
    if len(values) < len(rows):
        problems.append(f"{path.name}: {len(rows) - len(values)} bad rows skipped")
    problems.append(f"{path.name} has no orientation: errors of rotation mean nothing")
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1))
    return Trajectory(values[:, 0].copy(), np.hstack([values[:, 1:], turned]))


def from_matrices(times: npt.NDArray[np.float64], T_wc: Matrices) -> Trajectory:
    """A trajectory of matrices [N,4,4], whose rotations are replaced by the nearest true ones."""
    import torch

    from droidw.geometry import se3

    left, _, right = np.linalg.svd(T_wc[:, :3, :3])
    signs = np.ones((len(T_wc), 3))
    signs[:, 2] = np.sign(np.linalg.det(left @ right))
    clean = T_wc.copy()
    clean[:, :3, :3] = (left * signs[:, None, :]) @ right
    poses = se3.from_matrix(torch.from_numpy(clean)).numpy()
    return Trajectory(times.astype(np.float64), np.ascontiguousarray(poses, dtype=np.float64))


def _matches(
    truth: Trajectory, entries: Sequence[Entry], max_difference: float, problems: list[str]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """For each picture with a pose near in time: the row of that pose, and the picture's time."""
    times = np.array([time for _, time, _ in entries], dtype=np.float64)
    right = np.searchsorted(truth.times, times).clip(0, len(truth) - 1)
    left = (right - 1).clip(0)
    before = np.abs(truth.times[left] - times) < np.abs(truth.times[right] - times)
    best = np.where(before, left, right)
    near = np.abs(truth.times[best] - times) <= max_difference
    if not near.all():
        problems.append(
            f"{int((~near).sum())} of {len(near)} pictures have no true pose within "
            f"{max_difference:g} s"
        )
    return best[near].astype(np.int64), times[near]


def near_pictures(
    truth: Trajectory, entries: Sequence[Entry], max_difference: float, problems: list[str]
) -> Trajectory | None:
    """The true poses nearest in time to the pictures, with their own times, where near enough."""
    chosen = np.unique(_matches(truth, entries, max_difference, problems)[0])
    if not len(chosen):
        return None
    return Trajectory(truth.times[chosen], truth.T_wc[chosen])


def at_pictures(
    truth: Trajectory, entries: Sequence[Entry], max_difference: float, problems: list[str]
) -> Trajectory | None:
    """The same with the times of the pictures, each pose for the picture nearest to it alone.

    For truth whose clock is another: it may be further off than an evaluation allows.
    """
    rows, times = _matches(truth, entries, max_difference, problems)
    if not len(rows):
        return None
    off = np.abs(truth.times[rows] - times)
    order = np.lexsort((off, rows))
    first = np.concatenate([[True], np.diff(rows[order]) > 0])
    kept = np.sort(order[first])
    return Trajectory(times[kept], truth.T_wc[rows[kept]])
