"""Procedural textures of the synthetic scenes, and the atlas from which they are sampled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]

__all__ = ["LEVELS", "Atlas", "fabric", "furniture", "paint_box", "plain", "planks", "wall"]

LEVELS = 4
_PAD = 8
_SHELF = 2048


def noise(
    rng: np.random.Generator,
    height: int,
    width: int,
    cell: float,
    octaves: int,
    gain: float = 0.6,
    channels: int = 1,
) -> Image:
    """Multi-octave value noise [height,width,channels], zero mean, largest cell `cell` texels."""
    total = np.zeros((height, width, channels), dtype=np.float32)
    amplitude = 1.0
    for _ in range(octaves):
        rows, columns = int(height / cell) + 3, int(width / cell) + 3
        grid = rng.random((rows, columns, channels), dtype=np.float32) - 0.5
        size = (int(columns * cell) + 1, int(rows * cell) + 1)
        layer = cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC)
        total += amplitude * layer.reshape(size[1], size[0], channels)[:height, :width]
        amplitude *= gain
        cell = max(cell / 2.1, 1.5)
    return total


def _colour(rng: np.random.Generator, low: float, high: float, spread: float) -> Image:
    grey = rng.uniform(low, high)
    return np.clip(grey + rng.uniform(-spread, spread, 3), 10, 245).astype(np.float32)


def _corner_shade(height: int, width: int, strength: float = 0.28, reach: float = 70) -> Image:
    """Darker towards the borders, as where walls meet."""
    y = np.arange(height, dtype=np.float32)
    x = np.arange(width, dtype=np.float32)
    near_y = np.exp(-np.minimum(y, height - 1 - y) / reach)
    near_x = np.exp(-np.minimum(x, width - 1 - x) / reach)
    shade = 1 - strength * np.maximum(near_y[:, None], near_x[None, :])
    return shade[..., None].astype(np.float32)


def _soften(image: Image, sigma: float = 0.8) -> Image:
    """Band limit: edges get a width of about two texels."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


def _poster(rng: np.random.Generator, height: int, width: int) -> Image:
    """A picture with strong edges at many scales: patches, discs, lines, a frame."""
    image = np.empty((height, width, 3), np.float32)
    image[:] = _colour(rng, 60, 220, 40)
    image += 55 * noise(rng, height, width, max(height, width) / 3, 4, 0.6, 3)
    for _ in range(rng.integers(6, 14)):
        colour = _colour(rng, 20, 235, 60).tolist()
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        size = int(rng.integers(4, max(6, min(height, width) // 4)))
        kind = rng.integers(0, 3)
        if kind == 0:
            cv2.rectangle(
                image,
                (x, y),
                (x + size, y + int(size * rng.uniform(0.4, 1.6))),
                colour,
                -1,
                cv2.LINE_AA,
            )
        elif kind == 1:
            cv2.circle(image, (x, y), size // 2 + 2, colour, -1, cv2.LINE_AA)
        else:
            end = (int(rng.integers(0, width)), int(rng.integers(0, height)))
            cv2.line(image, (x, y), end, colour, int(rng.integers(1, 4)), cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), _colour(rng, 15, 60, 8).tolist(), 5)
    return image


def wall(rng: np.random.Generator, height: int, width: int) -> Image:
    """A plastered wall: faint noise, a skirting line, posters, and stretches with little on."""
    image = np.empty((height, width, 3), np.float32)
    image[:] = _colour(rng, 130, 190, 22)
    image += 26 * noise(rng, height, width, 120, 3, 0.6)
    patchy = np.clip(noise(rng, height, width, 150, 2) * 3 + 0.45, 0.08, 1)
    image += 30 * patchy * noise(rng, height, width, 16, 4, 0.75)
    for _ in range(max(2, width * height // 45000)):
        h, w = int(rng.integers(50, 130)), int(rng.integers(45, 140))
        y = int(rng.integers(8, max(9, height * 3 // 4 - h)))
        x = int(rng.integers(4, max(5, width - w - 4)))
        part = image[y : y + h, x : x + w]
        part[:] = _poster(rng, *part.shape[:2])
    image[-14:] = _colour(rng, 50, 90, 10)
    return _soften(image * _corner_shade(height, width))


def planks(rng: np.random.Generator, height: int, width: int) -> Image:
    """A wooden floor: boards of differing tone with grain along them and dark seams."""
    image = np.empty((height, width, 3), np.float32)
    base = np.array([150, 112, 78], np.float32) * rng.uniform(0.75, 1.15)
    board = 24
    for y in range(0, height, board):
        x = -int(rng.integers(0, 200))
        while x < width:
            length = int(rng.integers(140, 300))
            image[y : y + board, max(x, 0) : x + length] = base * rng.uniform(0.72, 1.2)
            if x > 0:
                image[y : y + board, x : x + 2] *= 0.5
            x += length
        image[y : y + 2] *= 0.5
    short = noise(rng, height, width // 5 + 1, 14, 4, 0.8)
    grain = cv2.resize(short, (width, height), interpolation=cv2.INTER_CUBIC)
    image *= (1 + 0.30 * grain[..., None]).astype(np.float32)
    image *= 1 + 0.25 * noise(rng, height, width, 90, 3)
    return _soften(image * _corner_shade(height, width))


def plain(rng: np.random.Generator, height: int, width: int) -> Image:
    """A ceiling: nearly blank, with faint stains and a few panel lines."""
    image = np.empty((height, width, 3), np.float32)
    image[:] = _colour(rng, 185, 215, 6)
    image += 12 * noise(rng, height, width, 90, 3)
    for x in range(100, width, 190):
        image[:, x : x + 3] -= 26
    for y in range(100, height, 190):
        image[y : y + 3] -= 26
    return _soften(image * _corner_shade(height, width))


def furniture(rng: np.random.Generator, height: int, width: int) -> Image:
    """The side of a cupboard or crate: panels with edges, labels and worn paint."""
    image = np.empty((height, width, 3), np.float32)
    image[:] = _colour(rng, 60, 180, 40)
    image += 40 * noise(rng, height, width, 40, 4, 0.7)
    step = int(rng.integers(34, 70))
    for y in range(0, height, step):
        image[y : y + 3] *= 0.55
    for x in range(0, width, step):
        image[:, x : x + 3] *= 0.55
    for _ in range(max(1, height * width // 7000)):
        h, w = int(rng.integers(12, 40)), int(rng.integers(12, 45))
        y, x = int(rng.integers(0, max(1, height - h))), int(rng.integers(0, max(1, width - w)))
        part = image[y : y + h, x : x + w]
        part[:] = _poster(rng, *part.shape[:2])
    return _soften(image)


def fabric(rng: np.random.Generator, height: int, width: int) -> Image:
    """What moving objects wear: warped stripes, blobs and noise in lively colours."""
    first, second = _colour(rng, 55, 110, 40), _colour(rng, 130, 190, 35)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    bend = 60 * noise(rng, height, width, 70, 2)[..., 0]
    angle = rng.uniform(0, np.pi)
    phase = (np.cos(angle) * x + np.sin(angle) * y + bend) / rng.uniform(5.0, 8.0)
    mix = np.clip(1.5 * np.sin(phase) + 0.5, 0, 1)[..., None]
    image = first * (1 - mix) + second * mix
    image += 45 * noise(rng, height, width, 20, 4, 0.8, 1)
    image += 18 * noise(rng, height, width, 40, 2, 0.6, 3)
    for _ in range(max(3, height * width // 1500)):
        centre = int(rng.integers(0, width)), int(rng.integers(0, height))
        cv2.circle(
            image,
            centre,
            int(rng.integers(3, 9)),
            _colour(rng, 10, 240, 50).tolist(),
            -1,
            cv2.LINE_AA,
        )
    return _soften(image.astype(np.float32))


def paint_box(
    paint: Callable[[np.random.Generator, int, int], Image],
    rng: np.random.Generator,
    sizes: list[tuple[int, int]],
) -> list[Image]:
    """Six faces (height, width) painted by `paint`, each a little brighter or darker."""
    shades = (0.86, 0.94, 1.08, 0.7, 1.0, 0.9)
    return [paint(rng, h, w) * shade for (h, w), shade in zip(sizes, shades, strict=True)]


@dataclass(frozen=True)
class Atlas:
    """All textures in one picture, with its smaller levels beside each other.

    Attributes:
        pixels: [H,W,3] uint8; level k is the k times halved picture, at column `columns[k]`.
        columns: [LEVELS] first column of each level.
        origins: [tiles,2] x, y of the first texel of each tile at level 0.
    """

    pixels: npt.NDArray[np.uint8]
    columns: npt.NDArray[np.float32]
    origins: npt.NDArray[np.float32]

    @staticmethod
    def pack(tiles: list[Image]) -> Atlas:
        """Place tiles on shelves; padding keeps levels from mixing neighbours."""
        step = 2 ** (LEVELS - 1)
        places, x, y, shelf = [], 0, 0, 0
        for tile in tiles:
            h = -(-(tile.shape[0] + 2 * _PAD) // step) * step
            w = -(-(tile.shape[1] + 2 * _PAD) // step) * step
            if x and x + w > _SHELF:
                x, y, shelf = 0, y + shelf, 0
            places.append((x, y, w, h))
            x, shelf = x + w, max(shelf, h)
        height = y + shelf
        width = max(x + w for x, _, w, _ in places)
        base = np.zeros((height, width, 3), np.uint8)
        for tile, (x, y, w, h) in zip(tiles, places, strict=True):
            filled = np.clip(np.rint(tile), 0, 255).astype(np.uint8)
            base[y : y + h, x : x + w] = cv2.copyMakeBorder(
                filled,
                _PAD,
                h - _PAD - tile.shape[0],
                _PAD,
                w - _PAD - tile.shape[1],
                cv2.BORDER_REPLICATE,
            )
        levels = [base]
        for _ in range(LEVELS - 1):
            size = levels[-1].shape[1] // 2, levels[-1].shape[0] // 2
            levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)))
        columns = np.cumsum([0] + [level.shape[1] for level in levels])
        pixels = np.zeros((height, int(columns[-1]), 3), np.uint8)
        for level, column in zip(levels, columns[:-1], strict=True):
            pixels[: level.shape[0], column : column + level.shape[1]] = level
        origins = np.array([(x + _PAD, y + _PAD) for x, y, _, _ in places], np.float32)
        return Atlas(pixels, columns[:-1].astype(np.float32), origins)

    def sample(self, x: Image, y: Image, level: Image) -> Image:
        """Colours [N,3] float32 at texel positions of level 0, blended between two levels."""
        level = np.clip(level, 0, LEVELS - 1 - 1e-3)
        low = level.astype(np.int32)
        blend = (level - low)[:, None]
        lower, upper = self._level(x, y, low), self._level(x, y, low + 1)
        return lower + blend * (upper - lower)

    def _level(self, x: Image, y: Image, level: npt.NDArray[np.int32]) -> Image:
        scale = np.exp2(-level.astype(np.float32))
        u = (x + 0.5) * scale - 0.5 + self.columns[level]
        v = (y + 0.5) * scale - 0.5
        # cv2.remap takes at most 32767 columns of coordinates: fold the list into rows.
        count = len(u)
        rows = -(-count // 4096)
        padded = np.zeros((2, rows * 4096), np.float32)
        padded[0, :count], padded[1, :count] = u, v
        maps = padded.reshape(2, rows, 4096)
        out = cv2.remap(self.pixels, maps[0], maps[1], cv2.INTER_LINEAR)
        return out.reshape(-1, 3)[:count].astype(np.float32)
