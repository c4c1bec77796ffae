"""Small videos for tests, written with PyAV."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np

SIZE = (96, 64)


def picture(i, size=SIZE):
    """Picture number i: a ramp that moves, and a red block in the upper left corner."""
    w, h = size
    x = np.arange(w)[None, :] + np.zeros((h, 1))
    image = np.stack([(x * 2 + 3 * i) % 256, x, x[:, ::-1]], axis=-1).astype(np.uint8)
    image[: h // 4, : w // 4] = (250, 10, 10)
    return image


def write_video(path, count=40, fps=25, times=None, codec="mpeg4", size=SIZE, options=None, hold=0):
    """A video of `count` pictures at `fps`, or at these `times`; the last is held `hold` (ms)."""
    with av.open(str(path), "w", options=options or {}) as out:
        stream = out.add_stream(codec, rate=fps)
        stream.width, stream.height = size
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.bit_rate = 400_000
        stream.codec_context.gop_size = 8
        if codec == "mpeg2video":
            stream.codec_context.max_b_frames = 2
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for i in range(len(times) if times is not None else count):
            frame = av.VideoFrame.from_ndarray(picture(i, size), format="rgb24")
            if times is not None:
                frame.pts, frame.time_base = times[i], Fraction(1, 1000)
            packets = stream.encode(frame)
            if hold and i == len(times) - 1:
                for packet in packets:
                    packet.duration = hold
            out.mux(packets)
        out.mux(stream.encode(None))
    return path


def write_packets(path, pictures, times):
    """MJPEG packets as they are, so that sizes may change and times may repeat (ms)."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mjpeg", rate=25)
        stream.width, stream.height = pictures[0].shape[1::-1]
        stream.pix_fmt = "yuvj420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for image, time in zip(pictures, times, strict=True):
            encoder = av.CodecContext.create("mjpeg", "w")
            encoder.width, encoder.height = image.shape[1::-1]
            encoder.pix_fmt, encoder.time_base = "yuvj420p", Fraction(1, 1000)
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            for packet in [*encoder.encode(frame), *encoder.encode(None)]:
                packet.stream, packet.time_base = stream, Fraction(1, 1000)
                packet.pts = packet.dts = time
                out.mux(packet)
    return path


def write_sound(path):
    """A file with a second of sound and nothing to see."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream("aac", rate=16000)
        for i in range(16):
            frame = av.AudioFrame.from_ndarray(
                np.zeros((1, 1024), np.float32), format="fltp", layout="mono"
            )
            frame.sample_rate, frame.pts = 16000, 1024 * i
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def turn(path, quarter_turns):
    """Tell players to turn an MP4 clockwise, by its track header's matrix."""
    a, b = {1: (0, 1), 2: (-1, 0), 3: (0, -1)}[quarter_turns]
    one = 1 << 16
    matrix = [a * one, b * one, 0, -b * one, a * one, 0, 0, 0, 1 << 30]
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = np.array(matrix, dtype=">i4").tobytes()
    path.write_bytes(data)
    return path
