"""All-pairs correlation of two feature maps, its pyramid, and the look-up in it (REFERENCE 1.3).

The volume of a pair is one matrix [h*w, S]: a row holds, for one cell of frame i, its correlation
with all cells of frame j at all four levels, one level after the other. Pooling is linear, so the
levels come out of one product with the pooled features. The low-memory look-up makes the same
matrix a few rows at a time and throws it away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.geometry.transfer import on_device

__all__ = ["LEVELS", "RADIUS", "Pyramid", "lookup", "lookup_lowmem", "smallest_side", "volume"]

LEVELS = 4
RADIUS = 3
_SIDE = 2 * RADIUS + 1
_TAPS = _SIDE + 1
# Elements of a volume that the low-memory look-up holds at a time.
_ROOM = {"cpu": 1 << 23, "cuda": 1 << 27}
# Edges whose windows are worked out at once.
_TOGETHER = {"cpu": 1, "cuda": 16}


def smallest_side() -> int:
    """Cells that a grid needs each way for all levels to have one."""
    return 1 << (LEVELS - 1)


class Pyramid:
    """Sizes of the levels of a grid of h x w cells, and where each begins in a row.

    Attributes:
        sizes: (rows, columns) of each level. starts: its first column in the volume.
        columns: S, columns of the volume.
    """

    def __init__(self, height: int, width: int) -> None:
        self.sizes = [(height >> level, width >> level) for level in range(LEVELS)]
        counts = [rows * columns for rows, columns in self.sizes]
        self.starts = [sum(counts[:level]) for level in range(LEVELS)]
        self.columns = sum(counts)

    def features(self, fmap: Tensor) -> Tensor:
        """A quarter of the features [128,h,w], and their 2x2 means again and again, [128,S]."""
        levels = [fmap[None] / 4.0]
        for _ in range(LEVELS - 1):
            levels.append(F.avg_pool2d(levels[-1], 2, stride=2))
        return torch.cat([level[0].flatten(1) for level in levels], dim=1)


def volume(fmap_i: Tensor, columns: Tensor) -> Tensor:
    """Correlation [h*w,S] of the cells of i with all cells of j at all levels.

    Args:
        fmap_i: [128,h,w]. columns: `Pyramid.features` of frame j.
    """
    return _cells(fmap_i) @ columns


def lookup(volumes: Sequence[Tensor], coords: Tensor, pyramid: Pyramid) -> Tensor:
    """Windows of 7x7 around the coordinates in each level, [E,196,h,w] float32, channels last.

    Channel 49 l + 7 (dx + 3) + (dy + 3); bilinear; what lies outside counts as 0.

    Args:
        volumes: E matrices [h*w,S] in any precision.
        coords: [E,h,w,2] cells of j, x then y.
    """

    def fetch(edge: int, index: Tensor, out: Tensor) -> None:
        out.copy_(torch.gather(volumes[edge], 1, index))

    return _lookup(fetch, coords, pyramid)


def lookup_lowmem(
    pairs: Sequence[tuple[Tensor, Tensor]], coords: Tensor, pyramid: Pyramid
) -> Tensor:
    """The same as `lookup`, with a few rows of a volume in memory at a time.

    Args:
        pairs: features of i [128,h,w] and `Pyramid.features` of j, for each of E edges.
        coords: [E,h,w,2].
    """
    rows = max(1, _ROOM["cuda" if coords.is_cuda else "cpu"] // pyramid.columns)

    def fetch(edge: int, index: Tensor, out: Tensor) -> None:
        fmap_i, columns = pairs[edge]
        cells = _cells(fmap_i)
        for first in range(0, cells.shape[0], rows):
            part = slice(first, first + rows)
            out[part] = torch.gather(cells[part] @ columns, 1, index[part])

    return _lookup(fetch, coords, pyramid)


def _cells(fmap: Tensor) -> Tensor:
    """A quarter of the features [128,h,w] as rows [h*w,128]."""
    return (fmap.flatten(1) / 4.0).t()


def _lookup(
    fetch: Callable[[int, Tensor, Tensor], None], coords: Tensor, pyramid: Pyramid
) -> Tensor:
    """Fetch the 8x8 cells around each coordinate at each level, and blend them."""
    count, height, width = coords.shape[:3]
    out = coords.new_empty(count, height, width, LEVELS * _SIDE * _SIDE, dtype=torch.float32)
    sizes = on_device([[w, h] for h, w in pyramid.sizes], coords.device)
    columns = sizes[:, 0, None, None]
    starts = on_device(pyramid.starts, coords.device)[:, None, None]
    scale = on_device([2.0**-level for level in range(LEVELS)], coords.device, coords.dtype)[
        :, None
    ]
    steps = torch.arange(-RADIUS, RADIUS + 2, device=coords.device)
    together = _TOGETHER["cuda" if coords.is_cuda else "cpu"]
    for first in range(0, count, together):
        group = slice(first, min(first + together, count))
        at = coords[group].reshape(-1, 1, 2) * scale
        # Beyond this nothing is in reach; it keeps wild coordinates out of the integers.
        at = torch.minimum(at.clamp_min(-2.0 * _TAPS), sizes + 2.0 * _TAPS)
        low = at.floor()
        part = at - low
        cell = low.long()[:, :, None] + steps[:, None]
        inside = (cell >= 0) & (cell < sizes[:, None])
        cell = torch.minimum(cell.clamp_min(0), sizes[:, None] - 1)
        index = starts + cell[..., None, :, 1] * columns + cell[..., 0, None]
        index = index.view(-1, height * width, LEVELS * _TAPS * _TAPS)
        known = torch.empty(index.shape, dtype=torch.float32, device=coords.device)
        for edge in range(group.start, group.stop):
            fetch(edge, index[edge - first], known[edge - first])
        # The first axis of a window is x, the second y.
        known = known.view(-1, LEVELS, _TAPS, _TAPS)
        known *= inside[..., 0, None] & inside[..., None, :, 1]
        known = torch.lerp(known[:, :, :-1], known[:, :, 1:], part[..., 0, None, None])
        known = torch.lerp(known[..., :-1], known[..., 1:], part[..., 1, None, None])
        out[group] = known.view(-1, height, width, out.shape[-1])
    return out.permute(0, 3, 1, 2)
