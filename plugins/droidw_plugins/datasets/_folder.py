"""Opening a folder of pictures."""

from __future__ import annotations

import math
from pathlib import Path

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw.io.calib import read_calibration
from droidw.io.images import IMAGE_SUFFIXES
from droidw.io.listing import Entry, in_folder, keep_rising, picture_folder, read_listing
from droidw.io.notes import Notes
from droidw_plugins.datasets._layout import VIDEO_SUFFIXES, looks_like_tum
from droidw_plugins.datasets._listing import ListedSource
from droidw_plugins.datasets._named import existing_folder
from droidw_plugins.datasets._truth import read_truth

__all__ = ["FolderReader"]

_EXPECTED = (
    "expected pictures (" + ", ".join(sorted(s[1:] for s in IMAGE_SUFFIXES)) + ") right in the "
    "folder or in rgb/ or images/ in it, or a list rgb.txt with lines `timestamp filename`"
)


class FolderReader:
    """A `DatasetReader` for pictures in a folder.

    Args:
        fps: assumed where neither `rgb.txt` nor the file names tell the times.
    """

    def __init__(self, fps: float = 30.0) -> None:
        self._fps = fps

    def recognises(self, source: str) -> bool:
        """Whether it is a folder with pictures, or one with no other folder in it."""
        path = Path(source)
        if not source or not path.is_dir() or looks_like_tum(path):
            return False
        if (path / "rgb.txt").is_file() or picture_folder(path) is not None:
            return True
        return not any(entry.is_dir() for entry in path.iterdir())

    def open(self, source: str, selection: Selection) -> ListedSource:
        """Open the folder; see `DatasetReader.open`."""
        path = existing_folder(source, _EXPECTED)
        problems: list[str] = []
        notes = Notes(problems)
        if (path / "rgb.txt").is_file():
            entries = keep_rising(read_listing(path / "rgb.txt", notes), notes)
        else:
            entries = self._unlisted(path, problems)
        notes.finish()
        out = ListedSource(
            path.resolve().name or "footage", entries, selection, problems, notes.skipped
        )
        if (path / "camera.txt").is_file():
            out.camera, note = read_calibration(path / "camera.txt", *out.size)
            problems.extend([note] if note else [])
        out.truth = read_truth(path / "groundtruth.txt", problems)
        return out

    def _unlisted(self, path: Path, problems: list[str]) -> list[Entry]:
        entries = in_folder(path)
        if not entries:
            videos = sorted(p for p in path.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
            hint = f"did you mean: droidw run {videos[0]}" if videos else _EXPECTED
            raise InputError(f"there is no picture in {path}", hint)
        if not math.isnan(entries[0][1]):
            return entries
        problems.append(
            f"{entries[0][2].parent} does not say when its pictures were taken: "
            f"{self._fps:g} a second assumed (reader.options.fps)"
        )
        return [(n, n / self._fps, file) for n, _, file in entries]
