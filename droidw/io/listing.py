"""Which pictures a folder of footage holds, in which order, and when they were taken."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median

from droidw.errors import InputError
from droidw.io.files import read_text
from droidw.io.images import list_images
from droidw.io.notes import Notes
from droidw.io.rising import longest_rising

__all__ = [
    "PICTURE_FOLDERS",
    "Entry",
    "in_folder",
    "keep_rising",
    "picture_folder",
    "read_listing",
    "without_remark",
]

Entry = tuple[int, float, Path]
"""Index of a picture, its time in seconds (NaN: not known), its file."""

PICTURE_FOLDERS = ("rgb", "images")
"""Folders within footage that may hold its pictures."""


def read_listing(path: Path, notes: Notes) -> list[Entry]:
    """Read `timestamp filename` lines; comments start with # at the beginning of a word.

    Lines without a usable time or name are noted and count as skipped pictures.

    Args:
        path: the list; names in it are relative to its folder.
        notes: receives a sentence per bad line.
    Returns:
        Entries with the position among all lines that are not comments.
    Raises:
        InputError: the file cannot be read or has no usable line.
    """
    entries: list[Entry] = []
    position = 0
    for number, line in enumerate(read_text(path, "lines `timestamp filename`").splitlines(), 1):
        text = without_remark(line)
        if not text:
            continue
        fields = re.split(r"[\s,]+", text, maxsplit=1)
        fault = ""
        try:
            time = float(fields[0])
        except ValueError:
            fault = f"'{fields[0]}' is not a time in seconds"
        else:
            if not math.isfinite(time):
                fault = f"'{fields[0]}' is not a time in seconds"
        if not fault and len(fields) < 2:
            fault = "no file name after the time"
        if fault:
            notes.skip(f"bad lines in {path.name}", f"{path.name}, line {number}: {fault}")
        else:
            entries.append((position, time, path.parent / fields[1].rstrip(", \t")))
        position += 1
    if not entries:
        raise InputError(f"{path} names no picture", "lines look like `1.033333 rgb/000031.jpg`")
    return entries


def without_remark(line: str) -> str:
    """A line of a listing without its remark, which begins at a # that no name holds."""
    return re.split(r"(?:^|\s)#", line, maxsplit=1)[0].strip()


def keep_rising(entries: Sequence[Entry], notes: Notes) -> list[Entry]:
    """The longest part of the entries whose times strictly rise.

    Pictures whose time repeats or runs backwards are left out and noted; taking the longest
    part keeps a single stray time far in the future from costing all that follows.
    """
    kept = set(longest_rising([time for _, time, _ in entries]))
    for i, (_, time, path) in enumerate(entries):
        if i not in kept:
            notes.skip(
                "pictures with a time that repeats or runs backwards",
                f"{path.name}: its time {time!r} s repeats or runs backwards",
            )
    return [entry for i, entry in enumerate(entries) if i in kept]


def in_folder(path: Path) -> list[Entry]:
    """The pictures of a folder without a listing, as `picture_folder` finds them; [] without any.

    They are in the order of the times that their names are, with these times; else in natural
    order, and no time is known.
    """
    folder = picture_folder(path)
    if folder is None:
        return []
    files = list_images(folder)
    times = _times_in_names(files)
    if times is None:
        return [(n, math.nan, file) for n, file in enumerate(files)]
    order = sorted(range(len(files)), key=lambda i: times[i])
    return [(n, times[i], files[i]) for n, i in enumerate(order)]


def picture_folder(path: Path) -> Path | None:
    """The folder itself or the one in it that has the pictures."""
    for folder in (path, *(path / name for name in PICTURE_FOLDERS)):
        if folder.is_dir() and list_images(folder):
            return folder
    return None


def _times_in_names(files: Sequence[Path]) -> list[float] | None:
    """Times in seconds, if all names are decimal numbers that look like them.

    They do if no two are the same and their usual distance is between 1 ms and 2 s.
    """
    if len(files) < 2 or not all(re.fullmatch(r"\d+\.\d+", file.stem) for file in files):
        return None
    times = [float(file.stem) for file in files]
    rising = sorted(times)
    gaps = [b - a for a, b in pairwise(rising)]
    return times if min(gaps) > 0 and 0.001 <= median(gaps) <= 2.0 else None
