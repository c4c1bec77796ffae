"""Which edges to propose: pure functions on a matrix of frame distances (REFERENCE 5.6)."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

__all__ = ["backend_edges", "frontend_edges", "neighbour_edges"]

Pair = tuple[int, int]
Distances = npt.NDArray[np.float64]

# Sums of steps are this much off at most: 0.7 + 0.7 + 0.6 are two.
_ROUNDING = 1e-6


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


def _positions(count: int, spans: Distances | None) -> list[float]:
    """How many usual steps lead to each of `count` keyframes."""
    positions: list[float] = np.cumsum(np.ones(count) if spans is None else spans).tolist()
    return positions


def _within(at: Sequence[float], centre: float, reach: float) -> slice:
    """The part of ascending positions that is so near."""
    low = bisect_left(at, centre - reach - _ROUNDING)
    return slice(low, bisect_right(at, centre + reach + _ROUNDING))


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
    spans: Distances | None = None,
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
        spans: [K], what part of a usual step leads to each keyframe: the suppression counts in
            usual steps; None where all are.
    """
    d = distance.astype(np.float64, copy=True)
    rows, cols = d.shape
    i_of = np.arange(first_i, first_i + rows)[:, None]
    j_of = np.arange(first_j, first_j + cols)[None, :]
    d[(j_of > i_of - radius) | (d > 100.0)] = np.inf
    at = _positions(max(first_i + rows, first_j + cols), spans)
    at_rows, at_cols = at[first_i : first_i + rows], at[first_j : first_j + cols]

    def suppress(i: int, j: int) -> None:
        reach = max(min(abs(at[i] - at[j]) - 2, nms), 0.0)
        near = _within(at_rows, at[i], reach)
        for a in range(near.start, near.stop):
            left = reach - abs(at_rows[a] - at[i])
            d[a, _within(at_cols, at[j], left)] = np.inf

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
    distance: Distances,
    *,
    radius: int,
    nms: int,
    threshold: float,
    max_factors: int,
    spans: Distances | None = None,
) -> list[Pair]:
    """Edges of a global graph over N keyframes, both directions of each pair.

    Args:
        distance: [N,N]; only entries (i, j) with j <= i - radius are read.
        radius: predecessors `i - radius - 1 ... i - 1` are always linked.
        nms: half width of the square that a chosen edge suppresses.
        threshold: largest distance of an edge that is not forced.
        max_factors: stop when this many directed edges are proposed.
        spans: as in `frontend_edges`, [N].
    """
    n = distance.shape[0]
    d = distance.astype(np.float64, copy=True)
    d[np.arange(n)[None, :] > np.arange(n)[:, None] - radius] = np.inf
    edges: list[Pair] = []
    for i in range(n):
        for j in range(max(i - radius - 1, 0), i):
            edges += [(i, j), (j, i)]
            d[i, j] = np.inf
    at = _positions(n, spans)
    for i, j in _ascending(d, threshold):
        if len(edges) > max_factors:
            break
        if not np.isfinite(d[i, j]):
            continue
        edges += [(i, j), (j, i)]
        d[_within(at, at[i], nms), _within(at, at[j], nms)] = np.inf
    return edges
