"""Videos, decoded in order of presentation with the times that the file gives (PyAV).

OpenCV's own reader is no fallback here: it sits on the same FFmpeg and knows no true times.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import av
import numpy as np
from av.error import FFmpegError

from droidw.errors import InputError
from droidw.io.notes import Notes
from droidw.slam.frame import RawFrame

if TYPE_CHECKING:
    import numpy.typing as npt
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

__all__ = ["VideoInfo", "decode_video", "probe_video"]

_ADVICE = "give a video (mp4, mov, mkv, webm, avi) or a folder of pictures"
# Formats under which FFmpeg opens texts and single pictures.
_NO_VIDEO = ("tty", "image2", "_pipe", "subtitle", "srt", "webvtt", "ass", "concat")


@dataclass(frozen=True)
class VideoInfo:
    """What the head of a video and its first picture tell.

    Attributes:
        width, height: of the picture as it is shown, after rotation.
        frames: how many pictures are expected, or None where unknown.
        fps: average pictures a second, or None where unknown.
        square: whether pixels are square.
    """

    width: int
    height: int
    frames: int | None
    fps: float | None
    square: bool


def probe_video(path: Path) -> VideoInfo:
    """Open a video and decode its first picture.

    Raises:
        InputError: there is no such file, it is no video, or no picture can be decoded.
    """
    with _opened(path) as container:
        stream = _stream(container, path)
        rate = stream.average_rate
        fps = float(rate) if rate else None
        frames: int | None = stream.frames or None
        end = _promised_end(container, stream)
        if frames is None and fps and end is not None:
            frames = max(1, round((end - _start(stream)) * fps))
        aspect = stream.sample_aspect_ratio
        for frame in _Pictures(container, stream, Notes([])):
            if frame is None or frame.is_corrupt:
                continue
            height, width = _upright(frame).shape[:2]
            return VideoInfo(width, height, frames, fps, aspect in (None, 0, 1))
    raise InputError(f"{path}: not one picture can be decoded", _ADVICE)


def decode_video(
    path: Path, notes: Notes, *, skip: int = 0, stride: int = 1, assumed_fps: float = 30.0
) -> Generator[RawFrame, None, None]:
    """Yield every `stride`-th picture after `skip`, turned upright, times strictly rising.

    Times are presentation times of the file in seconds. A picture that is damaged, of another
    size than the first, or whose time repeats or runs backwards is left out and noted; so is a
    file that ends before it should. Decoding uses threads.

    Args:
        path: the file.
        notes: receives what could not be used.
        skip, stride: counted over all pictures; those not taken are decoded but not converted.
        assumed_fps: where neither picture nor file tell the time.
    Raises:
        InputError: as `probe_video`.
    """
    index = -1
    shape: tuple[int, ...] | None = None
    last: float | None = None
    with _opened(path) as container:
        stream = _stream(container, path)
        step = 1.0 / float(stream.average_rate or assumed_fps)
        untimed = 0
        pictures = _Pictures(container, stream, notes)
        for frame in pictures:
            index += 1
            if frame is None:
                continue  # noted already
            label = f"{path.name}, picture {index}"
            if frame.pts is None:
                untimed += 1
                time = 0.0 if last is None else last + step
            else:
                time = float(frame.pts * _time_base(stream))
            if last is not None and time <= last:
                notes.skip(
                    "pictures with a time that repeats or runs backwards",
                    f"{label}: its time {time:.6f} s repeats or runs backwards",
                )
                continue
            if frame.is_corrupt:
                notes.skip("damaged pictures", f"{label} is damaged")
                continue
            last = time
            if index < skip or (index - skip) % stride:
                continue
            image = _upright(frame)
            if shape is None:
                shape = image.shape
            if image.shape != shape:
                notes.skip(
                    "pictures of another size",
                    f"{label} is {image.shape[1]}x{image.shape[0]} pixels where the first has "
                    f"{shape[1]}x{shape[0]}",
                )
                continue
            yield RawFrame(index, time, image, f"{index:06d}")
        if untimed:
            notes.add(
                f"{path.name} gives no time for {untimed} pictures: "
                f"{1 / step:g} a second assumed (reader.options.fps)"
            )
        due = _promised_end(container, stream)
        if last is not None and due is not None and pictures.end + max(0.1, 3 * step) < due:
            notes.add(
                f"{path.name} is cut short: it should last until {due:.2f} s, but only "
                f"{index + 1} pictures until {last:.2f} s could be read"
            )


def _opened(path: Path) -> InputContainer:
    if not path.exists():
        raise InputError(f"{path}: no such file", _ADVICE)
    if not path.is_file():
        raise InputError(f"{path} is not a file", _ADVICE)
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty", _ADVICE)
    try:
        container = av.open(str(path), metadata_errors="ignore")
    except FFmpegError as error:
        with path.open("rb") as stream:
            is_mp4 = stream.read(12)[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free")
        if is_mp4:
            raise InputError(
                f"{path} cannot be opened: its index is missing, so it was cut short or its "
                "recording never finished",
                "copy it again, or repair it with a tool such as untrunc",
            ) from error
        raise InputError(f"{path} is not a video that can be read", _ADVICE) from error
    if any(name in container.format.name for name in _NO_VIDEO):
        container.close()
        raise InputError(f"{path} is not a video ({container.format.long_name})", _ADVICE)
    return container


def _stream(container: InputContainer, path: Path) -> VideoStream:
    """The first stream of moving pictures, ready for threaded decoding."""
    attached = av.stream.Disposition.attached_pic
    streams = [s for s in container.streams.video if not s.disposition & attached]
    if not streams:
        only = "only sound" if container.streams.audio else "no pictures"
        raise InputError(f"{path} holds {only}", _ADVICE)
    stream = streams[0]
    if getattr(stream, "codec_context", None) is None:
        raise InputError(
            f"{path}: its pictures are in a coding that PyAV's FFmpeg cannot decode",
            "convert it: ffmpeg -i CLIP -c:v libx264 clip.mp4",
        )
    stream.thread_type = "AUTO"
    return stream


def _time_base(stream: VideoStream) -> Fraction:
    return stream.time_base if stream.time_base is not None else Fraction(1, 1)


def _start(stream: VideoStream) -> float:
    return float((stream.start_time or 0) * _time_base(stream))


class _Pictures:
    """Pictures in order of presentation; None for one that could not be decoded.

    Attributes:
        end: latest time in s at which a coded picture read so far stops being shown.
    """

    def __init__(self, container: InputContainer, stream: VideoStream, notes: Notes) -> None:
        self._container = container
        self._stream = stream
        self._notes = notes
        self.end = -math.inf

    def __iter__(self) -> Iterator[VideoFrame | None]:
        for packet in self._packets():
            at: float | None = None
            if packet is not None and packet.pts is not None:
                at = float(packet.pts * _time_base(self._stream))
                shown = float((packet.duration or 0) * _time_base(self._stream))
                self.end = max(self.end, at + shown)
            try:
                frames = self._stream.codec_context.decode(packet)
            except FFmpegError as error:
                if packet is None or packet.size == 0:
                    continue  # nothing was left to flush
                where = "" if at is None else f" near {at:.3f} s"
                self._notes.skip(
                    "pictures that cannot be decoded",
                    f"a picture{where} cannot be decoded ({error.strerror})",
                )
                yield None
                continue
            yield from frames

    def _packets(self) -> Iterator[Packet[VideoStream] | None]:
        """Coded pictures, then an empty packet that flushes the decoder also after an error."""
        try:
            yield from self._container.demux(self._stream)
        except FFmpegError as error:
            self._notes.add(f"reading stopped early: {error.strerror}")
            yield None


def _upright(frame: VideoFrame) -> npt.NDArray[np.uint8]:
    """The picture as RGB [H,W,3], turned as the file says it is to be shown."""
    image = np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)
    turns = round(frame.rotation / 90) % 4
    return np.ascontiguousarray(np.rot90(image, turns)) if turns else image


def _promised_end(container: InputContainer, stream: VideoStream) -> float | None:
    """Time at which the last picture should end, in s, or None where the file does not tell."""
    if stream.duration:
        return _start(stream) + float(stream.duration * _time_base(stream))
    # The duration of the whole may be that of a longer sound track.
    if container.duration and len(container.streams) == 1:
        if "matroska" in container.format.name:  # which counts from 0, wherever it begins
            return container.duration / av.time_base
        return (container.start_time or 0) / av.time_base + container.duration / av.time_base
    return None
