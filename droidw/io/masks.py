"""Masks that a user gives of what is to be ignored: which belongs to which picture, and reading."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw.errors import InputError
from droidw.io.images import list_images
from droidw.slam.frame import RawFrame

__all__ = ["UserMasks", "facts_of", "numbers_in_names", "seconds_in_names", "written_by_droidw"]

_LOSSLESS = (".png", ".bmp", ".tif", ".tiff")
_LOSSY = (".jpg", ".jpeg")
_NEAR = 0.02  # seconds between a picture and its mask, where names are times
_SAYS = "a mask is a picture per frame: black is used, everything else is ignored"


class UserMasks:
    """Masks in a folder, looked up frame by frame; safe to call from any thread.

    A mask belongs to the picture of the same name (`0012.png` to `0012.jpg`). Where the name of
    the first picture is not among the masks, they go by time if their names are seconds
    (`1311868164.36.png`) and one is within 0.02 s of the first picture; else by order, `10.png`
    after `9.png`, if there are as many as pictures; else by number, if their names are indices of
    frames counted from 0 (`000012.png`, as droidw writes them). Masks that droidw wrote
    (`masks/scale.json` says so) always go by number.

    Args:
        folder: of pictures; black is used, everything else is ignored (a JPEG: what is brighter
            than half, since its black is not clean).
        least, most: how many pictures the source has, before any selection: at least, and at
            most; None where that is unknown.
    Attributes:
        working: whether droidw wrote the masks, so that they show its working pictures.
    Raises:
        InputError: the folder is not there or holds no masks.
    """

    def __init__(self, folder: Path, least: int = 0, most: int | None = None) -> None:
        if not folder.is_dir():
            raise InputError(f"input.masks: {folder}: there is no such folder", _SAYS)
        files = [p for p in list_images(folder) if p.suffix.lower() in (*_LOSSLESS, *_LOSSY)]
        if not files:
            raise InputError(f"input.masks: {folder}: holds no masks", _SAYS)
        self.folder = folder
        self._least, self._most = least, most
        self._asked: set[int] = set()
        self._missing: set[int] = set()
        self._whole: set[int] = set()
        self._files = files
        self._by_name = {path.stem: path for path in self._files}
        self._times: npt.NDArray[np.float64] | None = None
        self.working = written_by_droidw(folder)
        self._by_index: dict[int, Path] | None = numbers_in_names(files) if self.working else None
        self._settled = self.working

    def of(self, frame: RawFrame) -> npt.NDArray[np.bool_] | None:
        """The mask [H,W] of a picture, True where it is to be ignored; None if it has none.

        Raises:
            InputError: the masks belong to other pictures, or the file is no picture.
        """
        if not self._settled:
            self._settle(frame)
        path = self._path(frame)
        self._asked.add(frame.index)
        if path is None:
            self._missing.add(frame.index)
            return None
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        if picture is None:
            raise InputError(f"input.masks: {path}: cannot be read as a picture")
        least = 127 if path.suffix.lower() in _LOSSY else 0
        mask = np.asarray((np.asarray(picture) > least).any(axis=2))
        if mask.all():
            self._whole.add(frame.index)
        return mask

    def _path(self, frame: RawFrame) -> Path | None:
        if self._times is not None:
            nearest = int(np.abs(self._times - frame.time).argmin())
            return self._files[nearest] if self._near(frame.time, nearest) else None
        if self._by_index is not None:
            return self._by_index.get(frame.index)
        return self._by_name.get(Path(frame.name).stem)

    def _near(self, time: float, row: int) -> bool:
        assert self._times is not None
        return bool(abs(self._times[row] - time) <= _NEAR)

    def hide_all(self) -> bool:
        """Whether nothing is left of any picture that was asked for."""
        return bool(self._asked) and self._whole == self._asked

    def problems(self) -> list[str]:
        """Sentences about pictures that had no mask."""
        if not self._missing:
            return []
        return [
            f"{len(self._missing)} of {len(self._asked)} pictures have no mask in {self.folder}, "
            "and were used whole"
        ]

    def _settle(self, first: RawFrame) -> None:
        """Decide by the first picture how masks are found."""
        self._settled = True
        stem = Path(first.name).stem
        if stem in self._by_name:
            return
        self._times = seconds_in_names(self._files)
        if self._times is not None:
            if self._near(first.time, int(np.abs(self._times - first.time).argmin())):
                return
            self._times = None
        count, least, most = len(self._files), self._least, self._most
        if least and least <= count and (most is None or count <= most):
            self._by_index = dict(enumerate(self._files))
            return
        numbers = numbers_in_names(self._files)
        if len(numbers) == count and (most is None or max(numbers) < most):
            self._by_index = numbers
            return
        pictures = f"{least}" if least else "an unknown number of"
        raise InputError(
            f"input.masks: {self.folder}: its {count} masks cannot be laid on {pictures} pictures: "
            f"none is called '{stem}' like the first picture, and the count is another",
            "name each mask like its picture (an all-black one for the first, if nothing is to be "
            "ignored there), or give one mask per picture",
        )


def numbers_in_names(files: Sequence[Path]) -> dict[int, Path]:
    """The files whose names are numbers alone, by that number."""
    return {int(path.stem): path for path in files if path.stem.isdecimal()}


def seconds_in_names(files: Sequence[Path]) -> npt.NDArray[np.float64] | None:
    """The times that the names are, or None if they are not all fractions of seconds."""
    try:
        times = np.array([float(path.stem) for path in files if "." in path.stem])
    except ValueError:
        return None
    return times if len(times) == len(files) and np.isfinite(times).all() else None


def written_by_droidw(folder: Path) -> bool:
    """Whether an exporter wrote these pictures, named by the index of the frame."""
    return facts_of(folder).get("named") == "index"


def facts_of(folder: Path) -> dict[str, Any]:
    """What the `scale.json` of an exporter says of the pictures beside it; {} without one."""
    try:
        facts = json.loads((folder / "scale.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}
