"""Masks and uncertainty maps as files: which belongs to which picture, and reading."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw.errors import InputError
from droidw.eval.associate import DEFAULT_MAX_DIFF, associate
from droidw.io.images import list_images
from droidw.io.listing import Entry, in_folder, read_listing
from droidw.io.masks import numbers_in_names, seconds_in_names, written_by_droidw
from droidw.io.notes import Notes

__all__ = [
    "find_masks",
    "frames_beside",
    "listed",
    "objects_by_number",
    "pictures_in",
    "read_mask",
    "read_uncertainty",
]

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_LOSSY = (".jpg", ".jpeg")
_HALF, _MOST_OBJECTS, _COLOURED = 127, 32, 31
"""Grey levels: what is brighter moves; numbers of objects go so far; channels of a colour differ by
more."""


def find_masks(folder: Path, source: Path | None = None) -> dict[int, Path]:
    """Masks by the index of their frame.

    Frames are the pictures of the source, if that is known, else of the folder beside the masks, as
    the readers of folders list them (`rgb.txt`; pictures right there, in `rgb/` or in `images/`). A
    mask has the name of its frame, or a name that is its time in seconds. Where no mask has such a
    name, they go by order if there are as many as frames, else by number, if their names are
    indices of frames counted from 0. Where no frames are known, they go by number if numbers are
    missing between theirs, else by order. Those that droidw wrote (`scale.json`) go by number.

    Args:
        folder: of the masks. source: folder that the run was made from, if it is known.
    Raises:
        InputError: if the folder is missing or holds no pictures, or if names and count of the
            masks are both other than those of the pictures.
    """
    files = pictures_in(folder)
    if not files:
        raise InputError(f"{folder}: holds no masks", "expected pictures, white where it moves")
    if written_by_droidw(folder):
        return numbers_in_names(files)
    by_stem = {path.stem: path for path in files}
    frames = frames_beside(folder, source)
    named = {index: by_stem[name] for index, name, _ in frames if name in by_stem}
    if not named:
        named = _by_time(files, frames)
    if named:
        return named
    if len(frames) == len(files):
        return {index: path for (index, _, _), path in zip(frames, files, strict=True)}
    numbers = numbers_in_names(files)
    if len(numbers) == len(files):
        gaps = max(numbers) - min(numbers) + 1 > len(numbers)
        if (frames and max(numbers) <= frames[-1][0]) or (gaps and not frames):
            return numbers
    if frames:
        raise InputError(
            f"{folder}: its {len(files)} masks cannot be laid on {len(frames)} pictures: none has "
            "the name of a picture, and the count is another",
            "name each mask like its picture, or give one mask per picture",
        )
    return dict(enumerate(files))


def _by_time(files: Sequence[Path], frames: Sequence[tuple[int, str, float]]) -> dict[int, Path]:
    """Masks whose names are seconds, by the index of the nearest frame; empty if they are not."""
    named = seconds_in_names(files)
    times = np.array([time for _, _, time in frames])
    if named is None or not len(times) or not np.isfinite(times).all():
        return {}
    try:
        found = associate(named, times, DEFAULT_MAX_DIFF)
    except InputError:
        return {}
    pairs = zip(found.est, found.ref, strict=True)
    return {frames[int(ref)][0]: files[int(est)] for est, ref in pairs}


def frames_beside(folder: Path, source: Path | None = None) -> list[tuple[int, str, float]]:
    """Index, name and time (NaN if unknown) of the pictures of the source, else beside the masks.

    Listed as the readers of folders list them, so that a picture has the index that a run gives it.
    """
    return [(index, path.stem, time) for index, time, path in listed(folder, source)]


def listed(folder: Path, source: Path | None) -> list[Entry]:
    """The pictures of the source, else those beside masks, as readers of folders list them."""
    for root in (source, folder.parent):
        if root is None or not root.is_dir():
            continue
        if (root / "rgb.txt").is_file():
            try:
                return read_listing(root / "rgb.txt", Notes([]))
            except InputError:
                continue
        found = in_folder(root)
        if found and (root == source or _go_with(found[0][2].parent, len(found), folder)):
            return found
    return []


def _go_with(pictures: Path, count: int, masks: Path) -> bool:
    """Whether pictures beside masks can be theirs: no masks, and no few that only lie there."""
    few = pictures == masks.parent and count < len(pictures_in(masks))
    return pictures != masks and not few


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder, in natural order.

    Raises:
        InputError: if there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder")
    return [path for path in list_images(folder) if path.suffix.lower() in _PICTURES]


def read_mask(path: Path, numbered: bool | None = None) -> npt.NDArray[np.bool_]:
    """A mask [H,W] bool from a picture: True where it moves.

    That is what is brighter than half, or has a colour, as where each object has one. Where values
    have 16 bits, or are numbers of objects, all but 0 moves.

    Args:
        path: of the picture. numbered: whether values are numbers of objects, as
            `objects_by_number` tells of all masks; None: as it does of this one alone.
    Raises:
        InputError: if the file is no picture.
    """
    picture = _values(path)
    brightest, darkest = picture.max(axis=2), picture.min(axis=2)
    if picture.dtype != np.uint8:
        return np.asarray(brightest > 0)
    if path.suffix.lower() in _LOSSY:  # its black is not clean, and its grey not without colour
        return np.asarray(brightest > _HALF)
    if _may_be_numbers(path, picture) if numbered is None else numbered:
        return np.asarray(brightest > 0)
    return np.asarray((brightest > _HALF) | (brightest - darkest > _COLOURED))


def objects_by_number(paths: Iterable[Path]) -> bool:
    """Whether the values of masks are numbers of objects: none is brighter than a few grey levels.

    Told of all masks of a folder at once: one alone may be dark because nothing moves in it.

    Raises:
        InputError: if a file is no picture.
    """
    return all(_may_be_numbers(path, _values(path)) for path in paths)


def _may_be_numbers(path: Path, picture: npt.NDArray[Any]) -> bool:
    grey = bool((picture == picture[..., :1]).all())
    lossless = path.suffix.lower() not in _LOSSY
    return lossless and grey and int(picture.max(initial=0)) <= _MOST_OBJECTS


def _values(path: Path) -> npt.NDArray[Any]:
    """The values [H,W,3] of a mask, as they are stored."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if picture is None:
        raise InputError(f"{path}: cannot be read as a picture")
    return np.asarray(picture)


def read_uncertainty(path: Path) -> npt.NDArray[np.uint16]:
    """A map [h,w] uint16 as it is stored; 8-bit pictures are read too.

    Raises:
        InputError: if the file is no grey picture.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"{path}: cannot be read as a picture")
    if picture.ndim != 2:
        raise InputError(f"{path}: is a colour picture", "uncertainty maps are grey, 16 bits")
    return np.asarray(picture).astype(np.uint16)
