"""Masks and uncertainty maps as files: which mask belongs to which picture, and reading."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw.errors import InputError
from droidw.eval.associate import DEFAULT_MAX_DIFF, associate
from droidw.io.images import list_images
from droidw.io.listing import Entry, in_folder, read_listing
from droidw.io.masks import facts_of, numbers_in_names, seconds_in_names, written_by_droidw
from droidw.io.notes import Notes

__all__ = [
    "check_shape",
    "find_masks",
    "frames_beside",
    "pictures_in",
    "read_mask",
    "read_uncertainty",
    "resize_mask",
    "shapes_shown",
]

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_STRETCH = 0.05
"""Largest relative difference of two ratios of sides that counts as the same shape: cropping to
whole cells takes off a few pixels."""

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
    return [(index, path.stem, time) for index, time, path in _pictures(folder, source)]


def _pictures(folder: Path, source: Path | None) -> list[Entry]:
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


def shapes_shown(
    uncertainty: Path, masks: Path, source: Path | None = None
) -> list[tuple[int, int]]:
    """Sizes (width, height) of which a mask may have the shape: working picture, raw picture.

    The first is what `scale.json` beside the maps says, the second that of a picture beside the
    masks or in the source; what is not known is left out.
    """
    found = []
    try:
        width, height = (int(side) for side in facts_of(uncertainty)["picture"])
        found.append((width, height))
    except (ValueError, KeyError, TypeError):
        pass  # maps of another program, or of an older droidw
    for _, _, path in _pictures(masks, source)[:1]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if picture is not None:
            found.append((picture.shape[1], picture.shape[0]))
    return [(width, height) for width, height in found if width > 0 and height > 0]


def check_shape(
    path: Path,
    mask: npt.NDArray[np.bool_],
    u: npt.NDArray[Any],
    shown: Sequence[tuple[int, int]] = (),
) -> None:
    """Refuse a mask whose sides have another ratio than those of the picture under its map.

    Args:
        path, mask: the mask [H,W] and its file. u: the map [h,w].
        shown: sizes of pictures that the mask may show; without any, the map itself tells the
            ratio as far as whole cells do.
    Raises:
        InputError: the mask does not show what the map shows.
    """
    height, width = mask.shape
    rows, columns = u.shape
    ratio = width / height
    if any(abs(ratio * h / w - 1) <= _STRETCH for w, h in shown):
        return
    least, most = columns / (rows + 1), (columns + 1) / rows
    slack = 1 + _STRETCH
    if not shown and min(least, columns / rows / slack) <= ratio <= max(
        most, columns / rows * slack
    ):
        return
    sizes = " or ".join(dict.fromkeys(f"{w}x{h}" for w, h in shown))
    raise InputError(
        f"{path}: a mask of {width}x{height} pixels does not fit "
        + (f"pictures of {sizes}" if sizes else f"uncertainty maps of {columns}x{rows} cells")
        + ": it has another shape",
        "masks may be of any size, but must show the whole picture; give those of this footage: "
        "--masks DIR",
    )


def read_mask(path: Path) -> npt.NDArray[np.bool_]:
    """A mask [H,W] bool from a picture: True where it moves.

    That is what is brighter than half, or has a colour, as where each object has one. Where values
    have 16 bits, or nothing is brighter than a few grey levels, these are numbers of objects, and
    all but 0 moves.

    Raises:
        InputError: if the file is no picture.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if picture is None:
        raise InputError(f"{path}: cannot be read as a picture")
    if np.asarray(picture).dtype != np.uint8:
        return np.asarray(np.asarray(picture).max(axis=2) > 0)
    brightest, darkest = np.asarray(picture).max(axis=2), np.asarray(picture).min(axis=2)
    if path.suffix.lower() in _LOSSY:  # its black is not clean, and its grey not without colour
        return np.asarray(brightest > _HALF)
    if np.array_equal(brightest, darkest) and brightest.max(initial=0) <= _MOST_OBJECTS:
        return np.asarray(brightest > 0)
    return np.asarray((brightest > _HALF) | (brightest - darkest > _COLOURED))


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


def resize_mask(mask: npt.NDArray[np.bool_], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Reduce a mask [H,W] to a grid [h,w]: True where at least half of a cell's area moves."""
    height, width = shape
    if mask.shape == shape:
        return np.array(mask, dtype=bool)
    if height <= mask.shape[0] and width <= mask.shape[1]:
        share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        # Half a cell may come out as 0.4999999.
        return np.asarray(share >= 0.5 - 1e-5)
    near = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(near > 0)
