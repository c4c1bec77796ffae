"""Sequences in the layout of the TUM RGB-D benchmark: rgb.txt, depth.txt, groundtruth.txt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw.io.listing import Entry, keep_rising, read_listing
from droidw.io.notes import Notes
from droidw.slam.frame import Trajectory
from droidw_plugins.datasets._listing import ListedSource
from droidw_plugins.datasets._named import Place
from droidw_plugins.datasets._truth import near_pictures, read_truth

__all__ = ["EXPECTED", "open_rgbd"]

EXPECTED = "expected rgb.txt with lines `timestamp filename`, and the folder rgb/ that it names"

_TRUTHS = ("groundtruth.txt", "pose.txt")
_PUBLISHED_DIFFERENCE = 0.08
_PUBLISHED_GAP = 1.0 / 60.0


def open_rgbd(
    place: Place,
    selection: Selection,
    max_difference: float,
    *,
    published: bool = False,
    correct: Callable[[Trajectory], Trajectory] | None = None,
) -> ListedSource:
    """Open a sequence; its camera is left to the caller.

    Only the colour pictures are read. A missing depth.txt or groundtruth.txt is no fault.

    Args:
        place: the sequence.
        selection: which pictures to take.
        max_difference: a true pose belongs to a picture if it is this near in time, in s.
        published: take the pictures that the published system takes (REFERENCE 6.2): those with
            a depth map and a true pose within 0.08 s, none nearer than 1/60 s to the one before.
        correct: applied to the true poses.
    Raises:
        InputError: there is no rgb.txt, or nothing in it can be used.
    """
    path = place.folder
    if not (path / "rgb.txt").is_file():
        raise InputError(f"{path} has no rgb.txt", EXPECTED)
    problems: list[str] = []
    notes = Notes(problems)
    entries = keep_rising(read_listing(path / "rgb.txt", notes), notes)
    truth = next((t for n in _TRUTHS if (t := read_truth(path / n, problems)) is not None), None)
    if published:
        max_difference = _PUBLISHED_DIFFERENCE
        entries = _published(path, entries, truth, problems)
    notes.finish()
    out = ListedSource(place.name, entries, selection, problems, notes.skipped)
    if truth is not None:
        truth = truth if correct is None else correct(truth)
        out.truth = near_pictures(truth, entries, max_difference, problems)
    return out


def _published(
    path: Path, entries: Sequence[Entry], truth: Trajectory | None, problems: list[str]
) -> list[Entry]:
    """The pictures that the published reader keeps, counted anew."""
    wanted = []
    if (path / "depth.txt").is_file():
        depth = read_listing(path / "depth.txt", Notes([]))
        wanted.append(np.sort([time for _, time, _ in depth]))
    else:
        problems.append("compat droid-w: there is no depth.txt, so no picture is left out for it")
    if truth is not None:
        wanted.append(truth.times)
    kept: list[Entry] = []
    for _, time, file in entries:
        if kept and time - kept[-1][1] <= _PUBLISHED_GAP:
            continue
        if all(np.abs(times - time).min() < _PUBLISHED_DIFFERENCE for times in wanted):
            kept.append((len(kept), time, file))
    if not kept:
        raise InputError(
            f"{path}: no picture has a depth map and a true pose within {_PUBLISHED_DIFFERENCE} s, "
            "as compat=[droid-w] asks",
            "leave compat out to use all pictures",
        )
    if len(kept) < len(entries):
        problems.append(
            f"compat droid-w: {len(kept)} of {len(entries)} pictures taken: with depth and truth "
            "within 0.08 s, and 1/60 s apart"
        )
    return kept
