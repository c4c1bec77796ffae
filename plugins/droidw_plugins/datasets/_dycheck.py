"""Opening a scene of DyCheck in the layout with a dense reconstruction by COLMAP."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw.io.images import list_images
from droidw.io.listing import Entry, keep_rising
from droidw.io.notes import Notes
from droidw.slam.frame import Trajectory
from droidw_plugins.datasets._colmap import read_poses
from droidw_plugins.datasets._listing import ListedSource
from droidw_plugins.datasets._named import Datasets
from droidw_plugins.datasets._truth import from_matrices

__all__ = ["DycheckReader"]

_EXPECTED = "expected dense/images/0_00000.png and so on, and dense/sparse/images.bin"
_NAME = re.compile(r"(\d+)_(\d+)")


class DycheckReader:
    """A `DatasetReader` for scenes of DyCheck.

    Args:
        fps: pictures a second; the files only count them.
        normalise: divide true positions by the distance from the first to the last (REFERENCE
            6.4), which is the unit of the published errors.
        datasets: where named scenes lie.
    """

    def __init__(self, fps: float, normalise: bool, datasets: Datasets) -> None:
        self._fps = fps
        self._normalise = normalise
        self._datasets = datasets

    def recognises(self, source: str) -> bool:
        """Whether it is `dycheck:...` or a folder with dense/images."""
        named = Datasets.names(source, "dycheck")
        return named or (bool(source) and (Path(source) / "dense" / "images").is_dir())

    def open(self, source: str, selection: Selection) -> ListedSource:
        """Open the scene; see `DatasetReader.open`."""
        place = self._datasets.locate(source, "dycheck", _EXPECTED)
        folder = place.folder / "dense" / "images"
        if not folder.is_dir():
            raise InputError(f"{place.folder} has no dense/images", _EXPECTED)
        problems: list[str] = []
        notes = Notes(problems)
        entries = keep_rising(self._entries(folder), notes)
        notes.finish()
        if not entries:
            raise InputError(f"{folder} has no picture of the moving camera (0_*.png)", _EXPECTED)
        out = ListedSource(place.name, entries, selection, problems, notes.skipped)
        out.camera = self._datasets.camera(place, out.size, problems)
        problems.append(f"time is the number in the name over {self._fps:g} pictures a second")
        out.truth = self._truth(place.folder / "dense" / "sparse" / "images.bin", entries, problems)
        return out

    def _entries(self, folder: Path) -> list[Entry]:
        """Pictures of camera 0, which is the one that moves, in the order of their numbers."""
        numbered = []
        for file in list_images(folder):
            match = _NAME.fullmatch(file.stem)
            if match is not None and int(match[1]) == 0:
                numbered.append((int(match[2]), file))
        numbered.sort(key=lambda pair: (pair[0], pair[1].name))
        return [(n, number / self._fps, file) for n, (number, file) in enumerate(numbered)]

    def _truth(self, path: Path, entries: list[Entry], problems: list[str]) -> Trajectory | None:
        if not path.is_file():
            problems.append("there is no dense/sparse/images.bin; the run is not scored")
            return None
        try:
            poses = read_poses(path)
        except InputError as error:
            problems.append(f"{error.message}; the run is not scored")
            return None
        known = [(time, poses[file.name]) for _, time, file in entries if file.name in poses]
        if len(known) < len(entries):
            problems.append(f"{len(entries) - len(known)} of {len(entries)} pictures have no pose")
        if not known:
            return None
        T_wc = np.stack([matrix for _, matrix in known])
        length = float(np.linalg.norm(T_wc[-1, :3, 3] - T_wc[0, :3, 3]))
        if self._normalise and length > 0:
            T_wc[:, :3, 3] /= length
        return from_matrices(np.array([time for time, _ in known]), T_wc)
