"""Opening a sequence of the EuRoC MAV dataset."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import yaml

from droidw.errors import InputError
from droidw.geometry import se3
from droidw.geometry.camera import Camera
from droidw.interfaces.datasets import Selection
from droidw.io.files import read_text
from droidw.io.listing import Entry, keep_rising
from droidw.io.notes import Notes
from droidw.slam.frame import Trajectory
from droidw_plugins.datasets._listing import ListedSource
from droidw_plugins.datasets._named import Datasets
from droidw_plugins.datasets._truth import from_matrices, near_pictures

__all__ = ["EurocReader"]

_EXPECTED = "expected mav0/cam0 with data.csv, data/ and sensor.yaml"
_NANO = 1e-9


class EurocReader:
    """A `DatasetReader` for EuRoC MAV, left camera.

    Args:
        max_difference: a true pose belongs to a picture if it is this near in time, in s.
        datasets: where named sequences lie.
    """

    def __init__(self, max_difference: float, datasets: Datasets) -> None:
        self._max_difference = max_difference
        self._datasets = datasets

    def recognises(self, source: str) -> bool:
        """Whether it is `euroc:...` or a folder with mav0/cam0, or that is mav0."""
        named = Datasets.names(source, "euroc")
        return named or (bool(source) and (_mav(Path(source)) / "cam0" / "data").is_dir())

    def open(self, source: str, selection: Selection) -> ListedSource:
        """Open the sequence; see `DatasetReader.open`."""
        place = self._datasets.locate(source, "euroc", _EXPECTED)
        mav = _mav(place.folder)
        problems: list[str] = []
        notes = Notes(problems)
        entries = keep_rising(_entries(mav / "cam0", notes), notes)
        notes.finish()
        if not entries:
            raise InputError(f"{mav / 'cam0' / 'data.csv'} names no picture", _EXPECTED)
        out = ListedSource(place.name, entries, selection, problems, notes.skipped)
        sensor = _sensor(mav / "cam0" / "sensor.yaml", problems)
        out.camera = _camera(sensor, out.size, problems)
        truth = _truth(mav / "state_groundtruth_estimate0" / "data.csv", sensor, problems)
        if truth is not None:
            out.truth = near_pictures(truth, entries, self._max_difference, problems)
        return out


def _mav(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _rows(path: Path, what: str) -> list[list[str]]:
    lines = read_text(path, what).splitlines()
    return [row for row in csv.reader(lines) if row and not row[0].lstrip().startswith("#")]


def _entries(camera: Path, notes: Notes) -> list[Entry]:
    found = []
    for n, row in enumerate(_rows(camera / "data.csv", "lines `nanoseconds,filename`")):
        try:
            time, name = int(row[0]) * _NANO, row[1].strip()
        except (ValueError, IndexError):
            notes.skip("bad lines in data.csv", f"data.csv: '{','.join(row)}' is no picture")
            continue
        found.append((n, time, camera / "data" / name))
    return found


def _sensor(path: Path, problems: list[str]) -> dict[str, Any]:
    """The calibration of the camera; empty where it cannot be used."""
    if path.is_file():
        lines = read_text(path, "a calibration").splitlines()
        try:
            found = yaml.safe_load("\n".join(li for li in lines if not li.startswith("%")))
        except yaml.YAMLError:
            found = None
        if isinstance(found, dict):
            return found
    problems.append(f"{path.name} cannot be used; the camera is unknown")
    return {}


def _numbers(values: object, count: int) -> list[float]:
    """That many finite numbers, or none."""
    try:
        found = [float(value) for value in values]  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        return []
    return found if len(found) == count and all(map(math.isfinite, found)) else []


def _camera(sensor: dict[str, Any], size: tuple[int, int], problems: list[str]) -> Camera | None:
    four = _numbers(sensor.get("intrinsics"), 4)
    bent = _numbers(sensor.get("distortion_coefficients", [0, 0, 0, 0]), 4)
    shape = _numbers(sensor.get("resolution", size), 2)
    if not four or not bent or shape != [float(side) for side in size]:
        if sensor:
            problems.append("sensor.yaml does not fit the pictures; the camera is unknown")
        return None
    fx, fy, cx, cy = four
    if not any(bent):
        return Camera(*size, fx, fy, cx, cy)
    return Camera(*size, fx, fy, cx, cy, tuple(bent), "opencv")


def _truth(path: Path, sensor: dict[str, Any], problems: list[str]) -> Trajectory | None:
    """Poses of the camera: those of the body, and T_BS of the camera in it."""
    if not path.is_file():
        return None
    said = sensor.get("T_BS")
    mounted = _numbers(said.get("data") if isinstance(said, dict) else None, 16)
    if not mounted:
        problems.append("sensor.yaml has no T_BS, so the truth of the body is not used")
        return None
    rows = [_numbers(row[:8], 8) for row in _rows(path, "poses of the body")]
    good = np.array([row for row in rows if row and np.linalg.norm(row[4:]) > 1e-6])
    if len(good) < len(rows):
        problems.append(f"state_groundtruth_estimate0: {len(rows) - len(good)} bad rows skipped")
    if not len(good):
        return None
    times: npt.NDArray[np.float64] = good[:, 0] * _NANO
    order = np.unique(times, return_index=True)[1]
    poses = good[order][:, [1, 2, 3, 5, 6, 7, 4]]  # position, quaternion wxyz -> xyzw
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    T_wb = se3.matrix(torch.from_numpy(poses)).numpy()
    return from_matrices(times[order], T_wb @ np.array(mounted).reshape(4, 4))
