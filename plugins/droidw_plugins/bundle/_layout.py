"""In what order the edges are worked on, and which poses may move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from droidw.geometry.transfer import upload
from droidw.solve.problem import BAProblem

__all__ = ["Bucket", "Layout", "Workspace", "make_layout"]


@dataclass(frozen=True)
class Bucket:
    """All source keyframes with the same number of outgoing edges.

    Attributes:
        start, stop: range of its edges in the sorted order; edge `start + s * degree + k` is
            the k-th edge of source s, so that a view groups the edges without a copy.
        first, last: range of its sources in `Layout.sources`.
        degree: edges per source.
    """

    start: int
    stop: int
    first: int
    last: int
    degree: int


@dataclass(frozen=True)
class Layout:
    """Edges sorted by (number of edges of the source, source, target).

    The order depends on the set of edges alone: the order in which a caller lists them cannot
    change the result.

    Attributes:
        order: [E] position of each sorted edge in the caller's list.
        ii, jj: [E] sorted.
        sources: [K] source keyframes in the order of the buckets.
        buckets: runs of sources with equal degree.
        pair_a, pair_b: [M] all ordered pairs of edges with one source, bucket by bucket, in the
            order (source, first edge, second edge).
        own: [E] where in that list an edge is paired with itself.
    """

    order: Tensor
    ii: Tensor
    jj: Tensor
    sources: Tensor
    buckets: tuple[Bucket, ...]
    pair_a: Tensor
    pair_b: Tensor
    own: Tensor


def make_layout(problem: BAProblem) -> Layout:
    """Sorts the edges [E] into buckets; a few microseconds of integer work on the host."""
    ii, jj = problem.ii, problem.jj
    src, dst = problem.edges()
    if src.size == 0:
        return Layout(ii, ii, jj, ii, (), ii, ii, ii)
    count = np.bincount(src)
    order = np.lexsort((dst, src, count[src]))
    src, dst = src[order], dst[order]
    heads = np.flatnonzero(np.concatenate(([True], src[1:] != src[:-1])))
    sources = src[heads]
    degrees = count[sources]
    buckets = []
    starts = np.flatnonzero(np.concatenate(([True], degrees[1:] != degrees[:-1])))
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for first, last in zip(starts, [*starts[1:], len(sources)], strict=True):
        degree, start, n = int(degrees[first]), int(heads[first]), int(last - first)
        buckets.append(Bucket(start, start + degree * n, int(first), int(last), degree))
        edges = start + np.arange(degree * n).reshape(n, degree)
        shape = (n, degree, degree)
        pairs.append(
            (
                np.broadcast_to(edges[:, :, None], shape).ravel(),
                np.broadcast_to(edges[:, None, :], shape).ravel(),
            )
        )
    pair_a, pair_b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    own = np.flatnonzero(pair_a == pair_b)
    arrays = (order, src, dst, sources, pair_a, pair_b, own)
    whole = upload(torch.from_numpy(np.concatenate(arrays)), ii.device)  # one copy for all
    move = torch.split(whole, [a.size for a in arrays])
    return Layout(move[0], move[1], move[2], move[3], tuple(buckets), *move[4:])


class Workspace:
    """Scratch tensors that survive from step to step, since fresh memory costs page faults.

    Holds no state that could change a result: every buffer is written before it is read.
    """

    def __init__(self) -> None:
        self._buffers: dict[str, Tensor] = {}

    def take(self, name: str, *shape: int, like: Tensor) -> Tensor:
        """An uninitialised tensor of this shape, with the dtype and device of `like`."""
        size = 1
        for n in shape:
            size *= n
        held = self._buffers.get(name)
        if (
            held is None
            or held.numel() < size
            or held.dtype != like.dtype
            or held.device != like.device
        ):
            held = torch.empty(size, dtype=like.dtype, device=like.device)
            self._buffers[name] = held
        return held[:size].view(shape)
