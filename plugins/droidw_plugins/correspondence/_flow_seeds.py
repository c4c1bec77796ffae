"""Points matched by what surrounds them, from which a search can set out whatever is predicted.

A dense search follows its start, and the coarse levels of its pyramid. Where a path has gone astray
before a wall with little on it, both are wrong, and lines on the wall can be matched to what is
predicted anywhere. The corners of such a wall, a few dozen in a picture, are found by their
descriptors wherever they went.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw_plugins.correspondence._flow_information import powers, slopes
from droidw_plugins.correspondence._flow_types import Array, Kept, held

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_types import FlowFrame

__all__ = ["Points", "SeedBook", "Seeds", "coherent", "detect", "drawn", "matched", "uncovered"]

Picture = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

# The picture is searched at this multiple of its size, where six times as many points match before
# a wall. Contrast below which a point is noise, and how much longer than broad it may be.
_LARGER = 2
_CONTRAST = 0.01
_ELONGATED = 15.0
# Ratio of distances to the best and to the second match (Lowe 2004), which must be another point.
_RATIO = 0.8
_ANOTHER = 3.0
# Pixels by which the way back may miss: one corner may be found twice, at different scales.
_BACK = 2.0
# Matches around one that have to move like it: how many, within how many pixels, and how alike, in
# pixels and in pixels per pixel of distance. One corner found twice has one vote.
_VOTES = 4
_AROUND = 80.0
_ALIKE = 2.0
_ALIKE_FAR = 0.1
# The Gaussian window in which it is told whether a point is held, pixels.
_HOLDS = 3.0
# Pixels around what is closed whose points may be on its contour.
_MARGIN = 2
# How far a seed draws the flow around it, pixels, and how many seeds' worth of staying there is.
_DRAWS = 10.0
_STAYS = 0.2
# Values of a descriptor are whole numbers up to this, so that their products are exact, in whatever
# order they are summed.
_WHOLE = 255.0
# Pictures whose points are kept, a fifth of a megabyte each, and pairs whose matches are.
_PICTURES = 400
_PAIRS = 20_000


@dataclass(frozen=True)
class Points:
    """Points of a picture: `at` [n,2] pixels, `descriptor` [n,128] uint8, [n] which are `held`."""

    at: Array
    descriptor: Picture
    held: Mask


@dataclass(frozen=True)
class Seeds:
    """Matched points: `here` [n,2] in one picture lie `there` [n,2] in the other, pixels.

    Those that are `held` [n], in both, do not slip along a line.
    """

    here: Array
    there: Array
    held: Mask

    def __len__(self) -> int:
        return len(self.here)

    def where(self, chosen: Mask) -> Seeds:
        """Those of them that are chosen, [n]."""
        return Seeds(self.here[chosen], self.there[chosen], self.held[chosen])

    def turned(self) -> Seeds:
        """The same from the other picture."""
        return Seeds(self.there, self.here, self.held)


class SeedBook:
    """Seeds between keyframes, found once for each pair.

    Args:
        most: points of a picture.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._points: Kept[tuple[int, int], Points] = Kept(_PICTURES)
        self._matches: Kept[tuple[tuple[int, int], tuple[int, int]], Seeds] = Kept(_PAIRS)

    def between(
        self, a: FlowFrame, b: FlowFrame, here: Mask | None = None, there: Mask | None = None
    ) -> Seeds:
        """Seeds from one frame to another, but for cells [h,w] that are taken out of either."""
        key = (a.key, b.key)
        seeds = self._matches.get(key)
        if seeds is None:
            seeds = matched(self._points_of(a), self._points_of(b))
            self._matches.put(key, seeds)
        return coherent(uncovered(seeds, here, there, a.stride))

    def _points_of(self, frame: FlowFrame) -> Points:
        points = self._points.get(frame.key)
        if points is None:
            points = detect(frame.sharp, self._most)
            self._points.put(frame.key, points)
        return points


def detect(grey: Picture, most: int) -> Points:
    """Points of a picture with their descriptors (SIFT: Lowe 2004; RootSIFT: Arandjelovic 2012).

    Args:
        grey: [H,W]. most: points that are kept, those of most contrast.
    """
    larger = cv2.resize(grey, None, fx=_LARGER, fy=_LARGER, interpolation=cv2.INTER_CUBIC)
    # without the last of these, points lie a quarter of its pixels to the right and below
    finder: Any = cv2.SIFT.create(
        most,
        contrastThreshold=_CONTRAST,
        edgeThreshold=_ELONGATED,
        enable_precise_upscale=True,
    )
    found, described = finder.detectAndCompute(larger, None)
    if described is None:
        return Points(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8), np.zeros(0, bool))
    at = (np.array([p.pt for p in found], np.float32) + 0.5) / np.float32(_LARGER) - 0.5
    share = described / np.maximum(described.sum(axis=1, keepdims=True), 1.0)
    at = at.astype(np.float32)
    return Points(at, np.rint(_WHOLE * np.sqrt(share)).astype(np.uint8), _held(grey, at))


def _held(grey: Picture, at: Array) -> Mask:
    """Which points [n,2] of a picture are held in both directions, [n]."""
    dx, dy = slopes(grey)
    tensor = (cv2.GaussianBlur(p, (0, 0), _HOLDS) for p in (dx * dx, dy * dy, dx * dy))
    height, width = grey.shape
    x, y = np.rint(at).astype(np.int64).clip(0, (width - 1, height - 1)).T
    return held(powers(*(part[y, x] for part in tensor)))


def matched(a: Points, b: Points) -> Seeds:
    """Points that are each other's nearest, and nearer than any other by Lowe's ratio."""
    if not len(a.at) or not len(b.at):
        return Seeds(a.at[:0], b.at[:0], a.held[:0])
    one, other = a.descriptor.astype(np.float32), b.descriptor.astype(np.float32)
    # Descriptors are as long as each other, but for rounding.
    apart = np.float32(_WHOLE**2) - one @ other.T
    best, back = apart.argmin(axis=1), apart.argmin(axis=0)
    mutual = _length(a.at[back[best]] - a.at) < _BACK
    best, rows = best[mutual], np.flatnonzero(mutual)
    left = apart[rows]
    distance = left[np.arange(len(rows)), best]
    left[_apart(b.at[best], b.at) < _ANOTHER] = np.inf
    # Squares of distances, by half.
    sure = distance < _RATIO**2 * left.min(axis=1)
    rows, best = rows[sure], best[sure]
    return Seeds(a.at[rows], b.at[best], a.held[rows] & b.held[best])


def coherent(seeds: Seeds) -> Seeds:
    """Those that move as others around them do."""
    moved = seeds.there - seeds.here
    distance = _apart(seeds.here, seeds.here)
    around = (distance < _AROUND) & (distance > _BACK)
    alike = _apart(moved, moved) < _ALIKE + _ALIKE_FAR * distance
    return seeds.where((around & alike).sum(axis=1) >= _VOTES)


def uncovered(seeds: Seeds, here: Mask | None, there: Mask | None, stride: int) -> Seeds:
    """Those that are not on cells taken out of either picture, [h,w] each, nor at their border."""
    for closed, turn in ((here, False), (there, True)):
        if closed is None or not len(seeds):
            continue
        at = seeds.there if turn else seeds.here
        height, width = closed.shape
        near = np.zeros(len(at), bool)
        for dx in (-_MARGIN, _MARGIN):
            for dy in (-_MARGIN, _MARGIN):
                x = ((at[:, 0] + 0.5 + dx) / stride).astype(np.int64).clip(0, width - 1)
                y = ((at[:, 1] + 0.5 + dy) / stride).astype(np.int64).clip(0, height - 1)
                near |= closed[y, x]
        seeds = seeds.where(~near)
    return seeds


def drawn(flow: Array, seeds: Seeds) -> tuple[Array, Array]:
    """The flow, drawn to where the seeds around say.

    Args:
        flow: [H,W,2] pixels.
    Returns:
        The flow [H,W,2], and how far off the seeds it was, [n] pixels.
    """
    height, width = flow.shape[:2]
    x = np.rint(seeds.here[:, 0]).astype(np.int64).clip(0, width - 1)
    y = np.rint(seeds.here[:, 1]).astype(np.int64).clip(0, height - 1)
    off = seeds.there - seeds.here - flow[y, x]
    pull = np.zeros((height, width, 3), np.float32)
    np.add.at(pull, (y, x), np.concatenate([off, np.ones_like(off[:, :1])], axis=1))
    pull = 2 * np.float32(np.pi) * _DRAWS**2 * cv2.GaussianBlur(pull, (0, 0), _DRAWS)
    return flow + pull[..., :2] / (pull[..., 2:] + np.float32(_STAYS)), _length(off)


def _length(vectors: Array) -> Array:
    """Lengths [...] of vectors [...,2]."""
    length: Array = np.hypot(vectors[..., 0], vectors[..., 1])
    return length


def _apart(here: Array, there: Array) -> Array:
    """Distances [n,m] from each of `here` [n,2] to each of `there` [m,2]."""
    x, y = (np.subtract.outer(here[:, k], there[:, k]) for k in (0, 1))
    x *= x
    y *= y
    x += y
    return np.sqrt(x, out=x)
