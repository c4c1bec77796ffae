"""Opening a video file."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw.io.notes import Notes
from droidw.io.prefetch import prefetch
from droidw.io.video import decode_video, probe_video
from droidw.slam.frame import RawFrame, Trajectory
from droidw_plugins.datasets._layout import VIDEO_SUFFIXES

if TYPE_CHECKING:
    from droidw.geometry.camera import Camera

__all__ = ["VideoReader", "VideoSource"]

_HEAD = 12


class VideoReader:
    """A `DatasetReader` for video files.

    Args:
        fps: assumed where the file gives no times.
    """

    def __init__(self, fps: float = 30.0) -> None:
        self._fps = fps

    def recognises(self, source: str) -> bool:
        """Whether the name or the first bytes are those of a video; it need not exist."""
        path = Path(source)
        if path.is_dir():
            return False
        if path.suffix.lower() in VIDEO_SUFFIXES:
            return True
        if not path.is_file():
            return False
        try:
            with path.open("rb") as stream:
                head = stream.read(_HEAD)
        except OSError:
            return False
        is_mp4, is_mkv = head[4:8] == b"ftyp", head[:4] == b"\x1a\x45\xdf\xa3"
        return is_mp4 or is_mkv or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")

    def open(self, source: str, selection: Selection) -> VideoSource:
        """Open the file; see `DatasetReader.open`."""
        return VideoSource(Path(source), selection, self._fps)


class VideoSource:
    """A `FrameSource` over a video file.

    Args:
        path: the file.
        selection: which pictures to take.
        fps: assumed where the file gives no times.
    Attributes:
        size: width and height of the pictures as shown.
    Raises:
        InputError: it is no video, no picture can be decoded, or the selection leaves none.
    """

    def __init__(self, path: Path, selection: Selection, fps: float) -> None:
        info = probe_video(path)
        if info.frames is not None and selection.skip >= info.frames > 0:
            raise InputError(
                f"{path}: of {info.frames} pictures, input.skip={selection.skip} leaves none",
                "make input.skip smaller than the number of pictures",
            )
        self.name = path.stem
        self.camera: Camera | None = None
        self.truth: Trajectory | None = None
        self.problems: list[str] = []
        self.skipped = 0
        self.size = (info.width, info.height)
        self.length: int | None = None
        if info.frames is not None:
            self.length = -(-(info.frames - selection.skip) // selection.stride)
            if selection.max_frames:
                self.length = min(self.length, selection.max_frames)
        if not info.square:
            self.problems.append(
                f"{path.name} has pixels that are not square; a guessed camera takes them for "
                "square, so give a calibration (--calib)"
            )
        self._path = path
        self._selection = selection
        self._fps = fps
        self._first_pass = True

    def frames(self) -> Iterator[RawFrame]:
        """A fresh pass; pictures are decoded ahead in a thread."""
        return prefetch(self._decode())

    def _decode(self) -> Generator[RawFrame, None, None]:
        first, self._first_pass = self._first_pass, False
        notes = Notes(self.problems if first else [])
        chosen = self._selection
        pictures = decode_video(
            self._path, notes, skip=chosen.skip, stride=chosen.stride, assumed_fps=self._fps
        )
        try:
            for done, frame in enumerate(pictures, 1):
                yield frame
                if done == chosen.max_frames:
                    break
        finally:
            pictures.close()
            notes.finish()
            if first:
                self.skipped = notes.skipped
