"""Which edges to propose: pure functions on a matrix of frame distances (REFERENCE 5.6)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

__all__ = ["backend_edges", "frontend_edges", "neighbour_edges"]

Pair = tuple[int, int]
Distances = npt.NDArray[np.float64]


def neighbour_edges(count: int, radius: int) -> list[Pair]:
    """All ordered pairs with 1 <= |i - j| <= radius among `count` keyframes."""
    return [
        (i, j)
        for i in range(count)
        for j in range(max(0, i - radius), min(count, i + radius + 1))
        if i != j
    ]


def _ascending(d: Distances, limit: float) -> list[tuple[int, int]]:
    """Indices of d with d <= limit, smallest first, ties in index order."""
    flat = d.ravel()
    order = np.argsort(flat, kind="stable")
    order = order[flat[order] <= limit]
    rows, cols = np.divmod(order, d.shape[1])
    return list(zip(rows.tolist(), cols.tolist(), strict=True))


def frontend_edges(
    distance: Distances,
    first_i: int,
    first_j: int,
    existing: Iterable[Pair],
    *,
    radius: int,
    nms: int,
    threshold: float,
    max_factors: int,
) -> list[Pair]:
    """Edges of the sliding window, both directions of each pair.

    Args:
        distance: [I,J], entry (a, b) between keyframes `first_i + a` and `first_j + b`.
        first_i, first_j: keyframes that the rows and columns start at.
        existing: edges already in the graph, active or not, around which is suppressed.
        radius: predecessors `i - radius - 1 ... i - 1` are always linked.
        nms: largest L1 radius of the suppression.
        threshold: largest distance of an edge that is not forced.
        max_factors: stop when this many directed edges are proposed.
    """
    d = distance.astype(np.float64, copy=True)
    rows, cols = d.shape
    i_of = np.arange(first_i, first_i + rows)[:, None]
    j_of = np.arange(first_j, first_j + cols)[None, :]
    d[(j_of > i_of - radius) | (d > 100.0)] = np.inf

    def suppress(i: int, j: int) -> None:
        reach = max(min(abs(i - j) - 2, nms), 0)
        for di in range(-reach, reach + 1):
            for dj in range(-reach, reach + 1):
                if abs(di) + abs(dj) <= reach:
                    a, b = i + di - first_i, j + dj - first_j
                    if 0 <= a < rows and 0 <= b < cols:
                        d[a, b] = np.inf

    for i, j in existing:
        suppress(i, j)
    edges: list[Pair] = []
    for i in range(first_i, first_i + rows):
        for j in range(max(i - radius - 1, 0), i):
            edges += [(i, j), (j, i)]
            if j >= first_j:
                d[i - first_i, j - first_j] = np.inf
    for a, b in _ascending(d, threshold):
        if len(edges) > max_factors:
            break
        if not np.isfinite(d[a, b]):
            continue
        i, j = a + first_i, b + first_j
        edges += [(i, j), (j, i)]
        suppress(i, j)
        d[a, b] = np.inf
    return edges


def backend_edges(
    distance: Distances, *, radius: int, nms: int, threshold: float, max_factors: int
) -> list[Pair]:
    """Edges of a global graph over N keyframes, both directions of each pair.

    Args:
        distance: [N,N]; only entries (i, j) with j <= i - radius are read.
        radius: predecessors `i - radius - 1 ... i - 1` are always linked.
        nms: half width of the square that a chosen edge suppresses.
        threshold: largest distance of an edge that is not forced.
        max_factors: stop when this many directed edges are proposed.
    """
    n = distance.shape[0]
    d = distance.astype(np.float64, copy=True)
    d[np.arange(n)[None, :] > np.arange(n)[:, None] - radius] = np.inf
    edges: list[Pair] = []
    for i in range(n):
        for j in range(max(i - radius - 1, 0), i):
            edges += [(i, j), (j, i)]
            d[i, j] = np.inf
    for i, j in _ascending(d, threshold):
        if len(edges) > max_factors:
            break
        if not np.isfinite(d[i, j]):
            continue
        edges += [(i, j), (j, i)]
        d[max(i - nms, 0) : i + nms + 1, max(j - nms, 0) : j + nms + 1] = np.inf
    return edges
