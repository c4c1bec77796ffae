"""Pictures with their times as an MP4 file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt

from droidw.errors import DroidwError, MissingRequirementError
from droidw.io.files import atomic_write

__all__ = ["CODECS", "stamps", "write_movie"]

CODECS = ("libvpx-vp9", "libsvtav1", "libopenh264", "mpeg4")
"""Encoders in the order in which they are taken; every browser shows the first three.

None is under the GPL: `libx264`, which PyAV's wheel has too, is, and is never used.
"""

_BASE = Fraction(1, 1000)
_SETTINGS = {
    # With a bit rate of 0 the quality is constant.
    "libvpx-vp9": {"deadline": "realtime", "cpu-used": "8", "crf": "24", "row-mt": "0"},
    "libsvtav1": {"preset": "10", "crf": "28", "svtav1-params": "lp=1"},
}
_BITS_PER_PIXEL = 2.5  # for encoders without a setting for quality


def stamps(times: Sequence[float]) -> tuple[list[int], int]:
    """Times in seconds as milliseconds from the first, and how long the last picture stays.

    Stamps rise strictly, as files demand: a time that does not comes 1 ms after the one before.
    The last picture stays for the median gap, a single one for a second.
    """
    at: list[int] = []
    for time in times:
        stamp = round(1000 * (time - times[0]))
        at.append(max(stamp, at[-1] + 1) if at else 0)
    return at, max(1, round(float(np.median(np.diff(at))))) if len(at) > 1 else 1000


def write_movie(
    path: Path,
    pictures: Iterable[npt.NDArray[np.uint8]],
    times: Sequence[float],
    codecs: Sequence[str] = CODECS,
) -> str:
    """Write pictures so that each is shown from its own time on.

    Args:
        path: the MP4 file.
        pictures: [H,W,3] uint8 RGB, all of one size; the last row or column is repeated where a
            side is odd, since the encoders want even sides.
        times: seconds, one per picture, at least one.
        codecs: the first of these that this build of PyAV has is used.
    Returns:
        The encoder that was used.
    Raises:
        MissingRequirementError: there is none of these encoders.
        DroidwError: the encoder failed.
        UsageError: the file cannot be written.
    """
    codec = next((name for name in codecs if name in av.codecs_available), None)
    if codec is None:
        raise MissingRequirementError(
            f"{path.name}: this build of PyAV has no encoder of {', '.join(codecs)}",
            "install the wheel: pip install --force-reinstall --only-binary :all: av",
        )
    at, hold = stamps(times)
    try:
        with (
            atomic_write(path) as stream,
            av.open(stream, "w", format="mp4") as container,
        ):
            _encode(container, codec, pictures, at, hold)
    except av.error.FFmpegError as error:
        raise DroidwError(f"{path.name}: the encoder {codec} failed: {error}") from error
    return codec


def _encode(
    container: Any,
    codec: str,
    pictures: Iterable[npt.NDArray[np.uint8]],
    at: list[int],
    hold: int,
) -> None:
    waiting = None
    for packet in _packets(container, codec, pictures, at, hold):
        if waiting is not None:
            container.mux(waiting)
        waiting = packet
    if waiting is not None:
        # Every other picture lasts until the next one begins.
        waiting.duration = hold
        container.mux(waiting)


def _packets(
    container: Any,
    codec: str,
    pictures: Iterable[npt.NDArray[np.uint8]],
    at: list[int],
    hold: int,
) -> Iterator[Any]:
    video: Any = None
    for stamp, picture in zip(at, pictures, strict=True):
        height, width = picture.shape[:2]
        if height % 2 or width % 2:
            picture = np.asarray(
                cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE),
                dtype=np.uint8,
            )
        if video is None:
            rate = min(60, max(1, round(1000 / hold)))
            video = container.add_stream(codec, rate=rate, options=_SETTINGS.get(codec, {}))
            video.width, video.height = picture.shape[1], picture.shape[0]
            video.pix_fmt = "yuv420p"
            context = video.codec_context
            context.time_base, context.max_b_frames, context.thread_count = _BASE, 0, 1
            known = codec in _SETTINGS
            bits = max(100_000, round(_BITS_PER_PIXEL * width * height * rate))
            video.bit_rate = 0 if known else bits
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame.pts, frame.time_base = stamp, _BASE
        yield from video.encode(frame)
    if video is not None:
        yield from video.encode(None)
