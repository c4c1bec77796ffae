"""Which depth map belongs to which frame."""

from __future__ import annotations

import bisect
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from droidw.io.masks import numbers_in_names, seconds_in_names

if TYPE_CHECKING:
    from droidw.slam.frame import Frame

__all__ = ["Lookup", "Rule"]

Rule = Literal["time", "name", "index"]


class Lookup:
    """Finds the map of a frame by time, by name or by position.

    Where that is left open it goes by time if there is a list of times; else by name from the first
    frame on whose name is among the maps, or but for its digits is one of theirs; else by time
    where names are seconds; else by position. Once it goes by one of these it stays with it: a
    frame without a map of its own gets none, and not that of another.

    By position, the number in the name is the index of the frame, counted from 0, where all names
    are numbers, unless these are 1, 2, 3 and so on without a gap; other names go in their order.

    Args:
        files: of maps, in their order; ascending by time if `times` are given.
        times: of the files, seconds; empty: not known.
        rule: None leaves it open.
        gap: seconds between frame and map at most.
    """

    def __init__(
        self, files: Sequence[Path], times: Sequence[float], rule: Rule | None, gap: float
    ) -> None:
        self._rule: Rule | None = "time" if rule is None and times else rule
        self._gap = gap
        self._by_stem = {file.stem: file for file in files}
        self._patterns = {_pattern(stem) for stem in self._by_stem}
        self._by_index = dict(enumerate(files))
        numbers = numbers_in_names(files)
        if len(numbers) == len(files) and sorted(numbers) != list(range(1, len(files) + 1)):
            self._by_index = numbers
        by_time = sorted(zip(times, files, strict=True)) if times else _timed(files)
        self._times = [time for time, _ in by_time]
        self._timed = [file for _, file in by_time]

    def of(self, frame: Frame) -> Path | None:
        """The map of a frame; None if it has none."""
        if self._rule is None:
            self._rule = self._rule_for(frame)
        if self._rule == "time":
            return self._nearest(frame.time)
        if self._rule == "name":
            return self._by_stem.get(Path(frame.name).stem)
        return self._by_index.get(frame.index)

    def _rule_for(self, frame: Frame) -> Rule:
        name = Path(frame.name)
        # pictures of a video have no name but their index
        if name.suffix and name.stem in self._by_stem:
            return "name"
        if self._times and self._nearest(frame.time) is not None:
            return "time"
        return "name" if name.suffix and _pattern(name.stem) in self._patterns else "index"

    def _nearest(self, time: float) -> Path | None:
        place = bisect.bisect_left(self._times, time)
        near = [k for k in (place - 1, place) if 0 <= k < len(self._times)]
        best = min(near, key=lambda k: abs(self._times[k] - time))
        return None if abs(self._times[best] - time) > self._gap else self._timed[best]


def _timed(files: Sequence[Path]) -> list[tuple[float, Path]]:
    """Times and files, ascending, where all names are fractions of seconds."""
    seconds = seconds_in_names(files)
    return [] if seconds is None else sorted(zip(seconds.tolist(), files, strict=True))


def _pattern(stem: str) -> str:
    """A name without what its digits are."""
    return re.sub(r"[0-9]", "0", stem)
