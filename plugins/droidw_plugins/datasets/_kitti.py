"""Opening a sequence of the KITTI odometry benchmark."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from droidw.errors import InputError
from droidw.geometry.camera import Camera
from droidw.interfaces.datasets import Selection
from droidw.io.files import read_text
from droidw.io.images import list_images
from droidw.io.listing import Entry, keep_rising
from droidw.io.notes import Notes
from droidw.slam.frame import Trajectory
from droidw_plugins.datasets._listing import ListedSource
from droidw_plugins.datasets._named import Datasets, Place
from droidw_plugins.datasets._truth import from_matrices

__all__ = ["KittiReader"]

_EXPECTED = "expected image_2/ (or image_0/), times.txt and calib.txt, as in sequences/00"
_CAMERAS = ("image_2", "image_0", "image_3", "image_1")
_Rows = npt.NDArray[np.float64]


class KittiReader:
    """A `DatasetReader` for KITTI odometry: the left colour camera, or whichever is there.

    Args:
        datasets: where named sequences lie.
    """

    def __init__(self, datasets: Datasets) -> None:
        self._datasets = datasets

    def recognises(self, source: str) -> bool:
        """Whether it is `kitti:...` or a folder with times.txt and the pictures of a camera."""
        path = Path(source)
        named = Datasets.names(source, "kitti")
        return named or (
            bool(source) and (path / "times.txt").is_file() and _pictures(path) is not None
        )

    def open(self, source: str, selection: Selection) -> ListedSource:
        """Open the sequence; see `DatasetReader.open`."""
        place = self._datasets.locate(source, "kitti", _EXPECTED)
        folder = _pictures(place.folder)
        if folder is None:
            raise InputError(f"{place.folder} has no folder of pictures", _EXPECTED)
        problems: list[str] = []
        notes = Notes(problems)
        entries = keep_rising(self._entries(place, folder, notes), notes)
        notes.finish()
        if not entries:
            raise InputError(f"{place.folder}: no picture has a time in times.txt", _EXPECTED)
        out = ListedSource(place.name, entries, selection, problems, notes.skipped)
        P = _projection(place.folder / "calib.txt", int(folder.name[-1]), problems)
        if P is not None:
            fx, fy, cx, cy = (float(P[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
            out.camera = Camera(*out.size, fx, fy, cx, cy)
        out.truth = self._truth(place, P, entries, problems)
        return out

    def _entries(self, place: Place, folder: Path, notes: Notes) -> list[Entry]:
        lines = read_text(place.folder / "times.txt", "a time in seconds per line").split()
        found = []
        for n, file in enumerate(list_images(folder)):
            number = int(file.stem) if file.stem.isdigit() else n
            try:
                time = float(lines[number])
            except (IndexError, ValueError):
                time = math.nan
            if math.isfinite(time):
                found.append((n, time, file))
            else:
                notes.skip("pictures without a time", f"{file.name}: times.txt has no time for it")
        return found

    def _truth(
        self, place: Place, P: _Rows | None, entries: list[Entry], problems: list[str]
    ) -> Trajectory | None:
        """Poses of camera 0 from poses/NN.txt, moved to the camera that took the pictures."""
        path = place.folder.parent.parent / "poses" / f"{place.folder.resolve().name}.txt"
        if not path.is_file():
            return None
        rows = _table(path, problems)
        if rows is None:
            return None
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3] = rows.reshape(-1, 3, 4)
        if P is not None:
            offset = np.eye(4)
            offset[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
            T = T @ np.linalg.inv(offset)
        numbers = [int(f.stem) if f.stem.isdigit() else n for n, _, f in entries]
        good = [k for k, n in enumerate(numbers) if n < len(T) and np.isfinite(T[n]).all()]
        if not good:
            return None
        times = np.array([entries[k][1] for k in good])
        return from_matrices(times, T[[numbers[k] for k in good]])


def _pictures(path: Path) -> Path | None:
    return next((path / n for n in _CAMERAS if (path / n).is_dir()), None)


def _projection(path: Path, camera: int, problems: list[str]) -> _Rows | None:
    """The projection matrix [3,4] of a camera out of calib.txt."""
    if path.is_file():
        match = re.search(rf"^P{camera}:(.*)$", read_text(path, "a calibration"), re.MULTILINE)
        values = match[1].split() if match else []
        try:
            P = np.array(values, dtype=np.float64).reshape(3, 4)
        except ValueError:
            P = np.zeros((3, 4))
        if np.isfinite(P).all() and P[0, 0] > 0 and P[1, 1] > 0 and P[2, 2] != 0:
            return P
    problems.append(f"{path.name} has no usable P{camera}; the camera is unknown")
    return None


def _table(path: Path, problems: list[str]) -> _Rows | None:
    """Rows of twelve numbers; a row that is none becomes not-a-number."""
    rows = []
    for line in read_text(path, "poses of twelve numbers").splitlines():
        fields = line.split()
        try:
            rows.append(
                [float(field) for field in fields] if len(fields) == 12 else [math.nan] * 12
            )
        except ValueError:
            rows.append([math.nan] * 12)
    table = np.array(rows, dtype=np.float64).reshape(-1, 12)
    bad = int((~np.isfinite(table).all(1)).sum())
    if bad:
        problems.append(f"{path.name}: {bad} bad rows skipped")
    return table if bad < len(table) else None
