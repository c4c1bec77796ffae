"""Opening sequences of DROID-W, and the YouTube clips that come with it."""

from __future__ import annotations

import math
import re
from pathlib import Path

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw.io.images import list_images
from droidw.io.listing import Entry, keep_rising
from droidw.io.notes import Notes
from droidw_plugins.datasets._listing import ListedSource
from droidw_plugins.datasets._named import Datasets
from droidw_plugins.datasets._truth import at_pictures, read_positions

__all__ = ["DroidwReader"]

_WALKS, _CLIPS = "droidw", "youtube"
_PICTURES = "images_anonymized"
_TRUTHS = ("traj_gt.txt", "traj_gt_fastlivo.txt")
_EXPECTED = f"expected {_PICTURES}/ with pictures that are named by their time in seconds"
_EXPECTED_CLIP = "expected rgb/ with frame00000.png or .jpg and so on"
_FRAME = re.compile(r"frame_?(\d+)")


class DroidwReader:
    """A `DatasetReader` for `droidw:downtown1` and `youtube:giraffe`.

    Args:
        max_difference: a true pose belongs to a picture if it is this near in time, in s.
        fps: of the YouTube clips, which only count their pictures.
        datasets: where named sequences lie.
    """

    def __init__(self, max_difference: float, fps: float, datasets: Datasets) -> None:
        self._max_difference = max_difference
        self._fps = fps
        self._datasets = datasets

    def recognises(self, source: str) -> bool:
        """Whether it is `droidw:...`, `youtube:...` or a folder with images_anonymized."""
        named = any(Datasets.names(source, name) for name in (_WALKS, _CLIPS))
        return named or (bool(source) and (Path(source) / _PICTURES).is_dir())

    def open(self, source: str, selection: Selection) -> ListedSource:
        """Open the sequence; see `DatasetReader.open`."""
        clip = Datasets.names(source, _CLIPS)
        expected = _EXPECTED_CLIP if clip else _EXPECTED
        place = self._datasets.locate(source, _CLIPS if clip else _WALKS, expected)
        folder = place.folder / ("rgb" if clip else _PICTURES)
        files = list_images(folder) if folder.is_dir() else []
        if not files:
            raise InputError(f"{folder} holds no picture", expected)
        problems: list[str] = []
        notes = Notes(problems)
        entries = keep_rising(
            self._counted(files, problems) if clip else _stamped(files, notes), notes
        )
        notes.finish()
        if not entries:
            raise InputError(f"{folder} has no picture with a time in its name", expected)
        out = ListedSource(place.name, entries, selection, problems, notes.skipped)
        out.camera = self._datasets.camera(place, out.size, problems)
        if not clip:
            paths = [place.folder / name for name in _TRUTHS]
            given = next((path for path in paths if path.is_file()), None)
            truth = read_positions(given, problems) if given is not None else None
            if truth is not None:
                out.truth = at_pictures(truth, entries, self._max_difference, problems)
        return out

    def _counted(self, files: list[Path], problems: list[str]) -> list[Entry]:
        """Clips: the number in the name tells the time, or else the place in the order."""
        problems.append(f"time is the number in the name over {self._fps:g} pictures a second")
        matches = [_FRAME.fullmatch(file.stem) for file in files]
        numbers = [int(m[1]) for m in matches if m is not None]
        if len(numbers) < len(files):
            numbers = list(range(len(files)))
        ordered = sorted(zip(numbers, files, strict=True), key=lambda pair: pair[0])
        return [(n, number / self._fps, file) for n, (number, file) in enumerate(ordered)]


def _stamped(files: list[Path], notes: Notes) -> list[Entry]:
    """Walks: the name is the time."""
    found = []
    for file in files:
        try:
            time = float(file.stem)
        except ValueError:
            time = math.nan
        if math.isfinite(time):
            found.append((time, file))
        else:
            notes.skip("pictures without a time", f"{file.name}: the name is not a time in seconds")
    found.sort(key=lambda pair: pair[0])
    return [(n, time, file) for n, (time, file) in enumerate(found)]
