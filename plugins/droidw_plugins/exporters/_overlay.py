"""Keyframe pictures with a warm tint where uncertainty took their weight away."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import numpy.typing as npt

from droidw.geometry.spread import spread
from droidw.slam.frame import KeyframeRecord

__all__ = ["overlays"]

_WARM = (255, 92, 20)  # RGB


def overlays(
    keyframes: Sequence[KeyframeRecord],
    stride: int,
    offset: float,
    start: float,
    alpha: float,
) -> Iterator[npt.NDArray[np.uint8]]:
    """Yield the picture of every keyframe, [H,W,3] uint8 RGB, tinted and stamped.

    Args:
        keyframes: pictures all of one size, weights all of one size.
        stride, offset: cell (x, y) lies at pixel stride * (x, y) + offset.
        start: time in seconds that is stamped as 0.
        alpha: opacity of the tint where the weight is 0; it falls evenly to 0 at weight 1.
    """
    if not keyframes:
        return
    height, width = keyframes[0].image.shape[:2]
    tint = np.empty((height, width, 3), np.uint8)
    tint[:] = _WARM
    for keyframe in keyframes:
        # A cell without a weight is not called moving.
        lost = 1 - np.clip(np.nan_to_num(keyframe.weight.astype(np.float32), nan=1.0), 0, 1)
        share = spread(alpha * lost, stride, offset, (width, height))
        blended = cv2.blendLinear(
            np.ascontiguousarray(keyframe.image), tint,
            np.asarray(1 - share, np.float32), np.asarray(share, np.float32),
        )  # fmt: skip
        picture = np.asarray(blended, dtype=np.uint8)
        _stamp(picture, f"{keyframe.time - start:.2f} s  #{keyframe.index:06d}")
        yield picture


def _stamp(picture: npt.NDArray[np.uint8], text: str) -> None:
    """Write small white text on a darkened strip into the lower left corner."""
    height, width = picture.shape[:2]
    size = min(0.45 * max(1.0, height / 300), width / 300)
    font, line = cv2.FONT_HERSHEY_SIMPLEX, max(1, round(1.5 * size))
    (text_width, text_height), below = cv2.getTextSize(text, font, size, line)
    edge = max(2, round(9 * size))
    strip = picture[max(0, height - text_height - below - edge) :, : text_width + 2 * edge]
    strip //= 3
    white = (255, 255, 255)
    where = (edge, height - below - edge // 2)
    cv2.putText(picture, text, where, font, size, white, line, cv2.LINE_AA)
