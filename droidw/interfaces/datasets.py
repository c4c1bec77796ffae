"""Dataset readers: footage in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from droidw.geometry.camera import Camera
    from droidw.slam.frame import RawFrame, Trajectory

__all__ = ["DatasetReader", "FrameSource", "Selection"]


@dataclass(frozen=True)
class Selection:
    """Which pictures to take: every `stride`-th after `skip`, `max_frames` at most (0: all)."""

    stride: int = 1
    skip: int = 0
    max_frames: int = 0


@runtime_checkable
class FrameSource(Protocol):
    """Opened footage, which can be read more than once.

    Attributes:
        name: short label, e.g. the folder's name; used for default run names.
        length: number of frames that a pass is expected to yield, or None if unknown.
        camera: calibration of the raw pictures, or None if the source has none.
        truth: ground-truth trajectory, or None. Only scored, never an input.
        problems: sentences about what could not be used ("rgb/000012.png: cannot be
            decoded, skipped"); grows during the first pass over `frames` and not after.
        skipped: how many pictures could not be used so far.
    """

    name: str
    length: int | None
    camera: Camera | None
    truth: Trajectory | None
    problems: list[str]
    skipped: int

    def frames(self) -> Iterator[RawFrame]:
        """A fresh pass from the start; times strictly rise, sizes are all the same."""
        ...


@runtime_checkable
class DatasetReader(Protocol):
    """Opens one kind of footage."""

    def recognises(self, source: str) -> bool:
        """Whether `source` (a path, or `name:sequence`) is this reader's; fast, no decoding."""
        ...

    def open(self, source: str, selection: Selection) -> FrameSource:
        """Open it.

        Raises:
            InputError: it cannot be used, with what was found and what would be valid.
        """
        ...
