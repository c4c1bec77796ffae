"""Footage that is a list of picture files with times: shared by the readers of folders."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from typing import TYPE_CHECKING

from droidw.errors import InputError
from droidw.io.images import read_image
from droidw.io.listing import Entry
from droidw.io.notes import Notes
from droidw.io.prefetch import prefetch
from droidw.slam.frame import RawFrame, Trajectory

if TYPE_CHECKING:
    from droidw.geometry.camera import Camera
    from droidw.interfaces.datasets import Selection

__all__ = ["ListedSource"]

_PROBES = 5


class ListedSource:
    """A `FrameSource` over picture files.

    Args:
        name: label of the source.
        entries: (index, time in s, file), times strictly rising.
        selection: which of them to take.
        problems: sentences so far; grows during the first pass.
        skipped: pictures that were left out so far.
    Attributes:
        size: width and height that most pictures have; others are skipped.
    Raises:
        InputError: none of the pictures can be decoded, or the selection leaves none.
    """

    def __init__(
        self,
        name: str,
        entries: Sequence[Entry],
        selection: Selection,
        problems: list[str],
        skipped: int,
    ) -> None:
        self.name = name
        self.camera: Camera | None = None
        self.truth: Trajectory | None = None
        self.problems = problems
        self.skipped = skipped
        self._limit = selection.max_frames
        self._entries = [
            entry
            for entry in entries
            if entry[0] >= selection.skip and (entry[0] - selection.skip) % selection.stride == 0
        ]
        if not self._entries:
            raise InputError(
                f"{name}: of {len(entries)} pictures, input.skip={selection.skip} and "
                f"input.stride={selection.stride} leave none",
                "make input.skip smaller than the number of pictures",
            )
        count = len(self._entries)
        self.length: int | None = min(count, self._limit) if self._limit else count
        self.size = self._most_common_size()
        self._first_pass = True

    def _most_common_size(self) -> tuple[int, int]:
        """Size of most of a few pictures spread over the whole; the earliest wins a tie."""
        last = len(self._entries) - 1
        probes = sorted({round(i * last / (_PROBES - 1)) for i in range(_PROBES)})
        rest = [i for i in range(last + 1) if i not in probes]
        sizes: Counter[tuple[int, int]] = Counter()
        reason = ""
        for tried, i in enumerate(probes + rest):
            if tried >= len(probes) and sizes:
                break
            try:
                height, width = read_image(self._entries[i][2]).shape[:2]
            except InputError as error:
                reason = error.message
                continue
            sizes[width, height] += 1
        if not sizes:
            raise InputError(
                f"{self.name}: none of the {last + 1} pictures can be used; "
                f"the last one tried: {reason}",
                f"for instance {self._entries[0][2]}",
            )
        return sizes.most_common(1)[0][0]

    def frames(self) -> Iterator[RawFrame]:
        """A fresh pass; pictures are decoded ahead in a thread."""
        return prefetch(self._decode())

    def _decode(self) -> Generator[RawFrame, None, None]:
        first, self._first_pass = self._first_pass, False
        notes = Notes(self.problems if first else [])
        done = 0
        for index, time, path in self._entries:
            if self._limit and done == self._limit:
                break
            try:
                image = read_image(path)
            except InputError as error:
                notes.skip("pictures that cannot be read", f"{path.name}: {error.message}")
                self.skipped += first
                continue
            height, width = image.shape[:2]
            if (width, height) != self.size:
                notes.skip(
                    "pictures of another size",
                    f"{path.name}: {width}x{height} pixels where the others have "
                    f"{self.size[0]}x{self.size[1]}",
                )
                self.skipped += first
                continue
            done += 1
            yield RawFrame(index, time, image, path.name)
        notes.finish()
