"""Write a short video of a textured room seen by a camera that moves sideways.

For the commands of README.md, which speak of a file `clip.mp4`: a far wall and a near box, so
that there is parallax, and nothing else that anyone would need a licence for.
"""

from __future__ import annotations

import sys
from fractions import Fraction

import av
import cv2
import numpy as np

WIDTH, HEIGHT, FRAMES, RATE = 320, 240, 48, 24
FOCAL = 300.0
WALL, BOX = 6.0, 2.5  # metres from the camera
STEP = 0.02  # metres per frame


def texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A picture with detail at several sizes, [height,width,3] uint8."""
    total = np.zeros((height, width, 3), np.float32)
    for cell, weight in ((64, 1.0), (24, 0.8), (8, 0.6), (3, 0.3)):
        coarse = rng.random((height // cell + 2, width // cell + 2, 3), dtype=np.float32)
        total += weight * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    total -= total.min()
    return np.asarray(total / total.max() * 255, np.uint8)


def picture(wall: np.ndarray, box: np.ndarray, x: float) -> np.ndarray:
    """What the camera at `x` metres to the right sees."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    view = cv2.warpAffine(
        wall, np.float32([[1, 0, 40 + FOCAL * x / WALL], [0, 1, 20]]), (WIDTH, HEIGHT), flags=flags
    )
    left = 180 - FOCAL * x / BOX
    move = np.float32([[1, 0, -left], [0, 1, -80]])
    front = cv2.warpAffine(box, move, (WIDTH, HEIGHT), flags=flags)
    mask = cv2.warpAffine(np.full(box.shape[:2], 255, np.uint8), move, (WIDTH, HEIGHT), flags=flags)
    alpha = mask[..., None].astype(np.float32) / 255
    return np.asarray(front * alpha + view * (1 - alpha), np.uint8)


def main(path: str) -> None:
    """Render and encode."""
    rng = np.random.default_rng(0)
    wall, box = texture(rng, HEIGHT + 60, WIDTH + 160), texture(rng, 90, 120)
    with av.open(path, "w") as container:
        stream = container.add_stream("mpeg4", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.bit_rate = 4_000_000
        stream.time_base = Fraction(1, RATE)
        for i in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(picture(wall, box, i * STEP), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


if __name__ == "__main__":
    main(sys.argv[1])
