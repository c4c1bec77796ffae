"""Opening a sequence of the TUM RGB-D benchmark."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from droidw.errors import InputError
from droidw.geometry.camera import Camera
from droidw.interfaces.datasets import Selection
from droidw.io.notes import Notes
from droidw.slam.frame import Trajectory
from droidw_plugins.datasets._folder import existing_folder, read_truth
from droidw_plugins.datasets._layout import looks_like_tum
from droidw_plugins.datasets._listing import Entry, ListedSource, keep_rising, read_listing

__all__ = ["TumReader"]

_EXPECTED = "expected rgb.txt with lines `timestamp filename`, and the folder rgb/ that it names"

# Colour cameras of the benchmark as its authors publish them: fx fy cx cy, k1 k2 p1 p2 k3.
# The pictures of freiburg3 are undistorted already.
_PUBLISHED = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
_SIZE = (640, 480)


class TumReader:
    """A `DatasetReader` for sequences of the TUM RGB-D benchmark.

    Args:
        max_difference: a true pose belongs to a picture if it is this near in time, in s.
    """

    def __init__(self, max_difference: float = 0.02) -> None:
        self._max_difference = max_difference

    def recognises(self, source: str) -> bool:
        """Whether it is a folder in the layout of the download."""
        path = Path(source)
        return bool(source) and path.is_dir() and looks_like_tum(path)

    def open(self, source: str, selection: Selection) -> ListedSource:
        """Open the sequence; see `DatasetReader.open`."""
        path = existing_folder(source, _EXPECTED)
        if not (path / "rgb.txt").is_file():
            raise InputError(f"{path} has no rgb.txt", _EXPECTED)
        problems: list[str] = []
        notes = Notes(problems)
        entries = keep_rising(read_listing(path / "rgb.txt", notes), notes)
        notes.finish()
        name = path.resolve().name
        out = ListedSource(name, entries, selection, problems, notes.skipped)
        out.camera = _published_camera(name, out.size, problems)
        truth = read_truth(path / "groundtruth.txt", problems)
        if truth is not None:
            out.truth = _nearest(truth, entries, self._max_difference, problems)
        return out


def _published_camera(name: str, size: tuple[int, int], problems: list[str]) -> Camera | None:
    """The benchmark's camera by the name of the sequence, or None."""
    match = re.search(r"(?:freiburg|fr)([123])(?!\d)", name)
    if match is None or size != _SIZE:
        problems.append(
            f"the name {name} does not say which camera of the benchmark took the pictures "
            "(freiburg1, 2 or 3, 640x480)"
        )
        return None
    four, bent = _PUBLISHED[match[1]]
    problems.append(
        f"camera: the published calibration of freiburg{match[1]}, taken by the folder's name"
    )
    return Camera(*_SIZE, *four, distortion=bent, model="opencv" if bent else "pinhole")


def _nearest(
    truth: Trajectory, entries: Sequence[Entry], max_difference: float, problems: list[str]
) -> Trajectory | None:
    """The true pose nearest in time to each picture, where one is near enough."""
    times = np.array([time for _, time, _ in entries])
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
    chosen = np.unique(best[near])
    if not len(chosen):
        return None
    return Trajectory(truth.times[chosen], truth.T_wc[chosen])
