"""Pictures of the report: keyframes with what was found in them, as data URIs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from droidw.slam.frame import KeyframeRecord
from droidw.solve.weights import CLOSED

__all__ = ["KeyframePictures", "choose", "colour_ramp", "data_uri", "keyframe_pictures"]

_WIDTH = 320


@dataclass(frozen=True)
class KeyframePictures:
    """One keyframe of the grid.

    Attributes:
        number: position among all keyframes.
        record: the keyframe.
        overlay, depth: data URIs of the picture with its uncertainty, and of the depth.
        moving: share of the cells that kept less than half of their weight.
        depth_share: share of the cells whose depth is seen consistently.
        width, height: size of both pictures in pixels.
    """

    number: int
    record: KeyframeRecord
    overlay: str
    depth: str
    moving: float
    depth_share: float
    width: int
    height: int


def choose(count: int, most: int) -> list[int]:
    """At most `most` of the numbers 0..count-1, evenly chosen, both ends among them."""
    if count <= most:
        return list(range(count))
    if most <= 1:
        return [count // 2][:most]
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]


def keyframe_pictures(
    keyframes: Sequence[KeyframeRecord], stride: int, offset: float, most: int
) -> list[KeyframePictures]:
    """Pictures of evenly chosen keyframes, uncertainty and depth each on one common scale.

    Cell (x, y) of the grid lies at pixel stride * (x, y) + offset of the working picture.
    """
    chosen = choose(len(keyframes), most)
    records = [keyframes[number] for number in chosen]
    u_low, u_high = _range([k.uncertainty for k in records])
    d_low, d_high = _range(
        [k.disp[k.depth_valid] if k.depth_valid.any() else k.disp for k in records]
    )
    pictures = []
    for number, record in zip(chosen, records, strict=True):
        image = cv2.cvtColor(np.ascontiguousarray(record.image), cv2.COLOR_RGB2BGR)
        full = (image.shape[1], image.shape[0])
        factor = min(1.0, _WIDTH / full[0])
        size = (max(1, round(full[0] * factor)), max(1, round(full[1] * factor)))
        if size != full:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)

        def spread(
            grid: npt.NDArray[np.float32],
            full: tuple[int, int] = full,
            size: tuple[int, int] = size,
        ) -> npt.NDArray[np.float32]:
            return _spread(grid, stride, offset, full, size)

        weight = np.clip(np.nan_to_num(spread(record.weight), nan=1.0), 0, 1)
        level = _level(spread(record.uncertainty), u_low, u_high)
        # The lower end of the map is black: what is tinted should glow, not darken.
        tint = cv2.applyColorMap((90 + 165 * level).astype(np.uint8), cv2.COLORMAP_INFERNO)
        alpha = (0.7 * (1 - weight))[..., None]
        overlay = (image * (1 - alpha) + tint * alpha).astype(np.uint8)

        if record.disp_full is not None:
            disp = np.asarray(
                cv2.resize(record.disp_full, size, interpolation=cv2.INTER_AREA), dtype=np.float32
            )
        else:
            disp = spread(record.disp)
        near = _level(disp, d_low, d_high)
        depth = cv2.applyColorMap((255 * near).astype(np.uint8), cv2.COLORMAP_TURBO)
        valid = np.clip(spread(record.depth_valid.astype(np.float32)), 0, 1)[..., None]
        # Not the brightness of the colours, which is low at both ends: near is light, far dark.
        grey = (60 + 90 * near)[..., None]
        shaded = (depth * valid + grey * (1 - valid)).astype(np.uint8)
        pictures.append(
            KeyframePictures(
                number=number,
                record=record,
                overlay=data_uri(overlay, ".jpg"),
                depth=data_uri(shaded, ".jpg"),
                moving=float(np.mean(record.weight < CLOSED)),
                depth_share=float(np.mean(record.depth_valid)),
                width=size[0],
                height=size[1],
            )
        )
    return pictures


def data_uri(picture: npt.NDArray[np.uint8], kind: str) -> str:
    """A picture (BGR or BGRA, uint8) as a `data:` URI; `kind` is ".jpg" or ".png"."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 82] if kind == ".jpg" else []
    done, data = cv2.imencode(kind, picture, options)
    if not done:
        raise ValueError(f"OpenCV cannot write a {kind} picture of shape {picture.shape}")
    mime = "image/jpeg" if kind == ".jpg" else "image/png"
    return f"data:{mime};base64,{base64.b64encode(data.tobytes()).decode('ascii')}"


def colour_ramp(name: str, steps: int = 9) -> str:
    """A CSS gradient, left to right, of the colours used for "uncertainty" or "depth"."""
    if name == "uncertainty":
        values, table = np.linspace(90, 255, steps), cv2.COLORMAP_INFERNO
    else:
        values, table = np.linspace(0, 255, steps), cv2.COLORMAP_TURBO
    colours = cv2.applyColorMap(values.astype(np.uint8)[None], table)[0]
    stops = ",".join(f"rgb({r},{g},{b})" for b, g, r in colours.tolist())
    return f"linear-gradient(90deg,{stops})"


def _spread(
    grid: npt.NDArray[np.float32],
    stride: int,
    offset: float,
    full: tuple[int, int],
    size: tuple[int, int],
) -> npt.NDArray[np.float32]:
    """A grid [h,w] sampled at the pixels of a picture reduced from `full` to `size` (W, H)."""
    x = ((np.arange(size[0]) + 0.5) * full[0] / size[0] - 0.5 - offset) / stride
    y = ((np.arange(size[1]) + 0.5) * full[1] / size[1] - 0.5 - offset) / stride
    map_x, map_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    sampled = cv2.remap(
        np.ascontiguousarray(grid, dtype=np.float32),
        map_x,
        map_y,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(sampled, dtype=np.float32)


def _range(maps: Sequence[npt.NDArray[np.float32]]) -> tuple[float, float]:
    """Percentiles 2 and 98 over all maps."""
    values = [m[np.isfinite(m)] for m in maps]
    values = [v for v in values if v.size]
    if not values:
        return 0.0, 1.0
    low, high = np.percentile(np.concatenate(values), [2, 98])
    return float(low), float(high) if high > low else float(low) + 1.0


def _level(values: npt.NDArray[np.float32], low: float, high: float) -> npt.NDArray[np.float32]:
    level = np.nan_to_num((values - low) / (high - low), nan=0.0, posinf=1.0, neginf=0.0)
    return np.asarray(np.clip(level, 0, 1), dtype=np.float32)
