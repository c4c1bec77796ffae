"""The order in which the GPU kernels work, made on the host and kept while the edges stay.

Everything here follows from the edges alone. The kernels need no other knowledge of the host, so a
step whose edges are those of the step before starts without asking the device for anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from droidw.geometry.transfer import on_device, upload

__all__ = ["KernelLayout", "TilePlan", "make_kernel_layout"]

Ints = npt.NDArray[np.int64]

TILED_FROM = 500
"""Keyframes from which on the system is kept in tiles that are not 0."""

TILE = 192
"""Rows of a tile: 32 poses."""


@dataclass(frozen=True)
class TileColumn:
    """One column of tiles, and what its elimination changes; tensors are on the device.

    Attributes:
        at: place of its tile on the diagonal.
        rows: [m] rows below that are not 0. here: [m] places of those tiles.
        left, right: [q] pairs of them (positions in `rows`). to: [q] the tile each pair changes.
    """

    at: int
    rows: Tensor
    here: Tensor
    left: Tensor
    right: Tensor
    to: Tensor


@dataclass(frozen=True)
class TilePlan:
    """Tiles of the lower triangle that are not 0, filled ones included.

    Attributes:
        count: rows of tiles. unknowns: rows of numbers, padded to whole tiles.
        index: (row, column) -> place in the storage [len(index), TILE, TILE].
        columns: the work, column by column.
    """

    count: int
    unknowns: int
    index: dict[tuple[int, int], int]
    columns: tuple[TileColumn, ...]


@dataclass(frozen=True)
class KernelLayout:
    """Arrays on the device by name, as `dw::Job` of csrc/job.h has them, and their sizes.

    Attributes:
        ii, jj: [E] edges in the order of the caller, to compare with.
        frames: number of frames.
        arrays: int64 tensors by name.
        sources, pairs, blocks: how many there are.
        tiles: how the system is stored, or None where it is one dense matrix.
        band: [F,B+1] where the blocks of `PoseTerm.band` begin in it, the first one of the system
            for those that do not exist; None without such a term.
    """

    ii: Tensor
    jj: Tensor
    frames: int
    arrays: dict[str, Tensor]
    sources: int
    pairs: int
    blocks: int
    tiles: TilePlan | None
    band: Tensor | None

    @property
    def stride(self) -> int:
        """Numbers from one row of the system to the next."""
        return TILE if self.tiles else 6 * self.frames

    @property
    def system_size(self) -> int:
        """Numbers in the storage of the system."""
        if self.tiles:
            return len(self.tiles.index) * TILE * TILE
        return (6 * self.frames) ** 2


def make_kernel_layout(
    ii: Tensor,
    jj: Tensor,
    frames: int,
    tiled_from: int = TILED_FROM,
    host: tuple[Ints, Ints] | None = None,
    reach: int | None = None,
) -> KernelLayout:
    """Sorts the edges [E] and lists which sums belong to which block of the system.

    Args:
        ii, jj: int64, on the device of the step.
        frames: number of frames.
        tiled_from: frames from which on tiles are used.
        host: the same edges on the host, if they are known there.
        reach: B of `PoseTerm.band`, if there is one.

    Raises:
        ValueError: an edge names a frame that does not exist.
    """
    src, dst = (ii.cpu().numpy(), jj.cpu().numpy()) if host is None else host
    for name, index in (("ii", src), ("jj", dst)):
        if index.size and not 0 <= index.min() <= index.max() < frames:
            raise ValueError(f"BAProblem.{name} names a frame outside 0..{frames - 1}")
    order = np.lexsort((dst, src == dst, src))
    i, j = src[order], dst[order]
    heads = np.flatnonzero(np.concatenate(([True], i[1:] != i[:-1]))) if i.size else i
    source_frame = i[heads]
    start = np.concatenate((heads, [i.size]))
    degree = np.diff(start)
    active = start[:-1] + np.add.reduceat((i != j).astype(np.int64), heads) if i.size else heads
    edge_source = np.repeat(np.arange(heads.size), degree)
    frame_source = np.full(frames, -1, dtype=np.int64)
    frame_source[source_frame] = np.arange(heads.size)

    pair_a, pair_b, pair_start = _pairs(start[:-1], active)
    moving = np.flatnonzero(i != j)
    by_target = moving[np.argsort(j[moving], kind="stable")]
    in_start = np.searchsorted(j[by_target], np.arange(frames + 1))

    rows, columns, parts = _parts(i, j, pair_a, pair_b, moving, source_frame)
    key = rows * frames + columns
    sort = np.argsort(key, kind="stable")
    key, parts = key[sort], parts[sort]
    first = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1]))) if key.size else key
    block_row, block_col = key[first] // frames, key[first] % frames
    band_row = np.repeat(np.arange(frames), 0 if reach is None else reach + 1)
    band_col = band_row - np.arange(band_row.size) % ((reach or 0) + 1)
    inside = band_col >= 0
    tiles = None
    if frames >= tiled_from:
        met_row = np.concatenate((block_row, band_row[inside]))
        met_col = np.concatenate((block_col, band_col[inside]))
        tiles = _tile_plan(met_row, met_col, frames, ii.device)
    places = np.zeros_like(band_row)
    places[inside] = _places(band_row[inside], band_col[inside], frames, tiles)
    named = {
        "order": order,
        "ii": i,
        "jj": j,
        "edge_source": edge_source,
        "source_frame": source_frame,
        "source_start": start,
        "source_active": active,
        "pair_start": pair_start,
        "pair_a": pair_a,
        "pair_b": pair_b,
        "frame_source": frame_source,
        "in_start": in_start,
        "in_edges": by_target,
        "diagonal": _places(np.arange(frames), np.arange(frames), frames, tiles),
        "block_row": block_row,
        "block_col": block_col,
        "block_at": _places(block_row, block_col, frames, tiles),
        "part_start": np.concatenate((first, [key.size])),
        "part": parts,
    }
    return KernelLayout(
        ii=ii.clone(),
        jj=jj.clone(),
        frames=frames,
        arrays=_on_device(named, ii.device),
        sources=int(heads.size),
        pairs=int(pair_a.size),
        blocks=int(first.size),
        tiles=tiles,
        band=None
        if reach is None
        else upload(torch.from_numpy(places), ii.device).view(frames, -1),
    )


def _on_device(named: dict[str, Ints], device: torch.device) -> dict[str, Tensor]:
    """One copy for all arrays; each is a view into it."""
    flat = np.concatenate([np.asarray(a, dtype=np.int64) for a in named.values()])
    whole = upload(torch.from_numpy(flat), device)
    sizes = [a.size for a in named.values()]
    return dict(zip(named, torch.split(whole, sizes), strict=True))


def _pairs(start: Ints, active: Ints) -> tuple[Ints, Ints, Ints]:
    """Pairs a <= b of the active edges of every source, source by source, and where each begins."""
    counts = active - start
    first: list[Ints] = []
    second: list[Ints] = []
    for begin, k in zip(start, counts, strict=True):
        a, b = np.triu_indices(int(k))
        first.append(begin + a)
        second.append(begin + b)
    ends = np.cumsum(counts * (counts + 1) // 2)
    empty = np.zeros(0, dtype=np.int64)
    return (
        np.concatenate([empty, *first]),
        np.concatenate([empty, *second]),
        np.concatenate((empty, ends - counts * (counts + 1) // 2)),
    )


def _parts(
    i: Ints, j: Ints, pair_a: Ints, pair_b: Ints, moving: Ints, source_frame: Ints
) -> tuple[Ints, Ints, Ints]:
    """Which sums belong to which block (row >= column): index * 8 + kind * 2 + transposed.

    Kinds: 0 a pair of edges at (j_a, j_b); 1 an edge's turned sum at (i, j); 2 a source at (i, i).
    """
    ja, jb = j[pair_a], j[pair_b]
    twice = np.flatnonzero((ja == jb) & (pair_a != pair_b))  # an edge that is given twice
    pair = np.concatenate((np.arange(pair_a.size), twice))
    row, column = np.concatenate((ja, ja[twice])), np.concatenate((jb, jb[twice]))
    turn = row < column
    turn[pair_a.size :] = True
    source = np.arange(source_frame.size)
    rows = np.concatenate((np.maximum(row, column), np.maximum(i, j)[moving], source_frame))
    columns = np.concatenate((np.minimum(row, column), np.minimum(i, j)[moving], source_frame))
    parts = np.concatenate((pair * 8 + turn, moving * 8 + 2 + (i < j)[moving], source * 8 + 4))
    return rows, columns, parts


def _tile_plan(block_row: Ints, block_col: Ints, frames: int, device: torch.device) -> TilePlan:
    """Tiles of the blocks, and those that a factorisation in the given order fills."""
    wide = TILE // 6
    count = -(-frames // wide)
    below: list[set[int]] = [set() for _ in range(count)]
    met = zip((block_row // wide).tolist(), (block_col // wide).tolist(), strict=True)
    for row, column in set(met):
        if row != column:
            below[column].add(row)
    for rows in below:
        if rows:
            # eliminating a column joins all rows below it; the first of them passes that on
            below[min(rows)] |= rows - {min(rows)}
    keys = [(k, k) for k in range(count)]
    keys += [(row, k) for k in range(count) for row in sorted(below[k])]
    index = {key: n for n, key in enumerate(keys)}

    def ready(values: list[int]) -> Tensor:
        return on_device(values, device)

    columns = []
    for k in range(count):
        rows_k = sorted(below[k])
        pairs = [(a, b) for a in range(len(rows_k)) for b in range(a + 1)]
        columns.append(
            TileColumn(
                at=index[k, k],
                rows=ready(rows_k),
                here=ready([index[r, k] for r in rows_k]),
                left=ready([a for a, _ in pairs]),
                right=ready([b for _, b in pairs]),
                to=ready([index[rows_k[a], rows_k[b]] for a, b in pairs]),
            )
        )
    return TilePlan(count, count * TILE, index, tuple(columns))


def _places(row: Ints, column: Ints, frames: int, tiles: TilePlan | None) -> Ints:
    """Where the block (row, column) of poses begins in the storage of the system."""
    if tiles is None:
        return row * 6 * (6 * frames) + column * 6
    wide = TILE // 6
    keys = zip((row // wide).tolist(), (column // wide).tolist(), strict=True)
    tile = np.array([tiles.index[key] for key in keys], dtype=np.int64)
    return tile * (TILE * TILE) + (row % wide) * 6 * TILE + (column % wide) * 6
