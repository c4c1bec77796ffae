"""What a picture and two ways of flow say of a match: how much across its lines, how much along."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw_plugins.correspondence._flow_types import Array

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_types import FlowFrame
    from droidw_plugins.correspondence.flow import FlowOptions

__all__ = [
    "agreement",
    "framed",
    "from_border",
    "information",
    "likeness",
    "powers",
    "sample",
    "slopes",
    "structure",
    "trust",
    "turned",
]

# Share of its confidence that a match beside the border keeps. It is off by what it shares with all
# others there, and still says more than nothing: before a bare wall there is little else.
_FRAMED = 0.25
# Squared image derivative below which a window counts as flat, (grey levels / pixel)^2.
_FLAT = 0.1
# Pixels at the border of a picture whose derivatives are not its own: of what lies beyond, Scharr
# and the blur before it know nothing.
_BORDER = 3
# Keeps the power of a flat window from being divided by itself.
_NOTHING = np.float32(1e-12)
# Mean square difference of a match without any error, grey levels^2: noise and rounding.
_NOISE = 2.0
# Square of the error of position, pixels^2, that good matches leave across an edge of depth.
_COMMON = 1.0
# How much longer a piece of line may become, and how far it may turn (cosine), to be the same line.
_LONGER = 2.0
_TURNED = 0.7


def sample(values: Any, points: Array, outside: float | None = None) -> Array:
    """Bilinear samples of [H,W(,C)] at points [h,w,2]; edge values (or `outside`) beyond."""
    mode = cv2.BORDER_REPLICATE if outside is None else cv2.BORDER_CONSTANT
    sampled = cv2.remap(
        values,
        np.ascontiguousarray(points[..., 0], dtype=np.float32),
        np.ascontiguousarray(points[..., 1], dtype=np.float32),
        cv2.INTER_LINEAR,
        borderMode=mode,
        borderValue=(outside or 0.0,) * 4,
    )
    result: Array = sampled.astype(np.float32, copy=False)
    return result


def structure(
    grey: Array, centres: Array, stride: int, covered: npt.NDArray[np.bool_] | None = None
) -> tuple[Array, Array, Array]:
    """The structure tensor (Foerstner and Guelch 1987) of the neighbourhood of each cell.

    What lies beyond the picture is flat. Were its outermost row repeated there, a line that leaves
    the picture would have a bend at the border, and a match that slips along it would be held.

    Args:
        grey: [H,W] in grey levels. centres: [h,w,2] pixels. stride: of the grid; a window has
            twice its width.
        covered: [H,W] pixels that count as flat: a contour of what moves says nothing of where a
            wall beside it went.
    Returns:
        `texture`, `power` and `normal` of `FlowFrame`, [h,w,2] each.
    """
    window = (2 * stride - 1, 2 * stride - 1)
    dx, dy = slopes(grey)
    for slope in (dx, dy):
        slope[:_BORDER] = slope[-_BORDER:] = 0.0
        slope[:, :_BORDER] = slope[:, -_BORDER:] = 0.0
        if covered is not None:
            slope[covered] = 0.0
    xx, yy, xy = (
        sample(cv2.blur(p, window, borderType=cv2.BORDER_CONSTANT), centres)
        for p in (dx * dx, dy * dy, dx * dy)
    )
    # What the window says of x once y is free, and the other way round: an oblique edge,
    # along which a match may slide, then counts for little in both.
    alone_x = xx - xy * xy / (yy + _FLAT)
    alone_y = yy - xy * xy / (xx + _FLAT)
    texture = np.sqrt(np.maximum(np.stack([alone_x, alone_y], -1), 0.0))
    angle = 0.5 * np.arctan2(xy, (xx - yy) / 2)
    normal = np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)
    return texture, powers(xx, yy, xy), normal


def slopes(grey: Array | npt.NDArray[np.uint8]) -> tuple[Array, Array]:
    """Derivatives of a picture [H,W] by x and by y, grey levels per pixel, [H,W] each."""
    dx: Any = cv2.Scharr(grey, cv2.CV_32F, 1, 0, scale=1 / 32)
    dy: Any = cv2.Scharr(grey, cv2.CV_32F, 0, 1, scale=1 / 32)
    return dx, dy


def powers(xx: Array, yy: Array, xy: Array) -> Array:
    """Of structure tensors [...], the power across the strongest edge and along it, [...,2]."""
    mean, off = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    # running sums over a flat window may end below 0
    power: Array = np.maximum(np.stack([mean + off, mean - off], -1), 0.0)
    return power


def trust(apart: Array, normal: Array, options: FlowOptions) -> tuple[Array, Array]:
    """How far both ways agree, in [0,1], across the strongest edge and along it, [h,w] each.

    A match may slip along an edge and still be right across it, as long as it does not slip so
    far that it has left the edge.

    Args:
        apart: [h,w,2] where the way there and back ends, seen from its start, pixels.
        normal: [h,w,2] of `FlowFrame`.
    """
    across = apart[..., 0] * normal[..., 0] + apart[..., 1] * normal[..., 1]
    error2 = (apart**2).sum(axis=-1)
    first = 1.0 / (1.0 + across**2 / options.consistency**2)
    first[(np.abs(across) > options.cutoff) | (error2 > options.slide**2)] = 0.0
    second = 1.0 / (1.0 + error2 / options.consistency**2)
    second[error2 > options.cutoff**2] = 0.0
    return first.astype(np.float32), second.astype(np.float32)


def likeness(
    a: FlowFrame, b: FlowFrame, flow: Array, pixels: Array, error: float, gain: float = 1.0
) -> Array:
    """How far the neighbourhood of each cell looks alike at both ends of a flow, [h,w] in [0,1].

    A search both ways that sets out from the same wrong geometry comes back to where it began. What
    is left of the difference in brightness betrays it: divided by the power of the picture it is
    the square of an error e of position, to first order. A pixel is no reproach, and beyond it the
    share is `1 / (1 + (e^2 - 1) / error^2)`. A difference that the whole window has does not count.

    Args:
        a, b: frames; what was searched is `a.grey` in `b.grey`.
        flow: [H,W,2] pixels. pixels: [H,W,2] coordinates x, y of the pixels.
        error: pixels.
        gain: of brightness, from `a` to `b`.
    """
    apart = a.grey - sample(b.grey, pixels + flow) / np.float32(gain)
    window = (2 * a.stride - 1, 2 * a.stride - 1)
    mean, square = (
        sample(cv2.blur(p, window, borderType=cv2.BORDER_REPLICATE), a.centres)
        for p in (apart, apart * apart)
    )
    left = np.maximum(square - mean * mean - _NOISE, 0.0) / (a.power.sum(axis=-1) + _FLAT)
    share: Array = 1.0 / (1.0 + np.maximum(left - _COMMON, 0.0) / error**2)
    return share.astype(np.float32)


def turned(frame: FlowFrame, flow: Array, reach: int) -> Array:
    """`normal` of a frame as it is where the flow leads: across the line in the other picture.

    A match slips along its line as that runs there. Where the camera rolls or passes a wall, a slip
    judged by how the line ran here looks like motion across it.

    Args:
        flow: [H,W,2] pixels. It takes two points of the line with it, however it slips along it.
        reach: pixels along the line to these points; 0: as it is here.
    Returns:
        [h,w,2] unit vectors; as it is here where what becomes of the line is not like it.
    """
    if reach == 0:
        return frame.normal
    along = np.float32(reach) * np.stack([-frame.normal[..., 1], frame.normal[..., 0]], -1)
    ahead, behind = (sample(flow, frame.centres + step) for step in (along, -along))
    there = 2 * along + ahead - behind
    length = np.maximum(np.hypot(there[..., 0], there[..., 1]), _NOTHING)
    grown = length / (2 * reach)
    alike = (grown > 1 / _LONGER) & (grown < _LONGER)
    alike &= np.abs((there * along).sum(axis=-1)) > _TURNED * reach * length
    normal = np.stack([there[..., 1], -there[..., 0]], -1) / length[..., None]
    result: Array = np.where(alike[..., None], normal, frame.normal)
    return result


def framed(a: FlowFrame, moved: Array, border: float) -> Array:
    """What matches keep of their confidence by how near the border of either picture they are.

    Patches and refinement have neighbours on one side only there, and windows end with the picture
    or repeat its last row, which stays where it is while the picture moves.

    Args:
        moved: [h,w,2] displacement of the cells, pixels.
        border: pixels from it.
    Returns:
        [h,w], 1 or a quarter; a match that leaves the picture has a quarter, too.
    """
    ends = (a.centres, a.centres + moved)
    inside = np.minimum(*(from_border(end, a.grey.shape) for end in ends))
    share: Array = np.where(inside < border, np.float32(_FRAMED), np.float32(1.0))
    return share


def from_border(points: Array, size: tuple[int, ...]) -> Array:
    """Pixels from each point [h,w,2] to the border of a picture of H, W; < 0 outside, [h,w]."""
    last = np.array([size[1] - 1, size[0] - 1], np.float32)
    distance: Array = np.minimum(points, last - points).min(axis=-1)
    return distance


def agreement(a: FlowFrame, b: FlowFrame, moved: Array, gain: float = 1.0) -> Array:
    """Agreement [h,w] in brightness at both ends of the flow, and 0 outside the picture.

    Args:
        moved: [h,w,2] displacement of the cells, pixels.
        gain: of brightness, from `a` to `b`.
    """
    there = a.centres + moved
    inside = from_border(there, a.grey.shape) >= 0
    difference = np.abs(sample(a.grey, a.centres) * np.float32(gain) - sample(b.grey, there))
    # A change of brightness by 10 grey levels is worth two pixels of position where the
    # picture is steep and says nothing where it is flat: texture decides there.
    tolerance = 6.0 + 1.5 * a.texture.max(axis=-1)
    agrees: Array = inside / (1.0 + (difference / tolerance) ** 2)
    return agrees.astype(np.float32)


def information(
    frame: FlowFrame,
    across: Array,
    along: Array,
    options: FlowOptions,
    normal: Array | None = None,
) -> Array:
    """Information (xx, yy, xy) of matches from a frame, [h,w,3] float32.

    Along each eigenvector of the structure tensor its eigenvalue says how much of the trust counts:
    power / (power + texture^2). A bend, a blurred end or noise of a strong line gives it some power
    along itself, by which a match that slips along the line would count as known: the second counts
    by r^2 / (r^2 + edge_leak^2), with r its share of the first.

    Args:
        across, along: [h,w] in [0,1], trust along the first and the second eigenvector.
        options: with `texture` 0 the picture is not asked.
        normal: [h,w,2] of the first eigenvector in the other picture; None: as in the frame.
    """
    first, second = across, along
    if options.texture > 0:
        strong, weak = frame.power[..., 0], frame.power[..., 1]
        level = np.float32(options.texture**2)
        first = across * strong / (strong + level)
        leaked = (np.float32(options.edge_leak) * strong) ** 2
        held = weak**2 / np.maximum(weak**2 + leaked, _NOTHING)
        second = along * held * weak / (weak + level)
    normal = frame.normal if normal is None else normal
    x, y = normal[..., 0], normal[..., 1]
    matrix = np.stack(
        [first * x * x + second * y * y, first * y * y + second * x * x, (first - second) * x * y],
        -1,
    )
    whole: Array = matrix.astype(np.float32)
    return whole
