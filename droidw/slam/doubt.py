"""Whether tracking holds: how much of the measured motion the poses explain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.linalg import vector_norm

from droidw.geometry.projective import pixel_grid, reproject
from droidw.solve.weights import agreeing_and_known, agreeing_share, agreeing_weight

if TYPE_CHECKING:
    from droidw.graph.factors import FactorGraph
    from droidw.graph.store import KeyframeStore

__all__ = [
    "Link",
    "doubtful",
    "explained_across",
    "explained_around",
    "explained_reach",
    "explained_share",
    "explained_weight",
    "scatter",
    "weakest_link",
]

# Distance of measured and predicted place, in cells, at which they agree by half.
_SCALE = 0.2


@dataclass(frozen=True)
class Link:
    """What holds a path together between two keyframes.

    Attributes:
        share: of what was measured across, what agrees with poses and depths; NaN if unknown.
        frame: index of the first of both; -1 if unknown.
    """

    share: float = float("nan")
    frame: int = -1

    def broken(self, below: float) -> bool:
        """Whether less than this agrees. What is unknown is not."""
        return self.share < below


def doubtful(agreement: float, below: float) -> bool:
    """Whether so little agrees that a run should look again.

    Args:
        agreement: what `explained_share` said in the end. NaN, where nothing was adjusted, is no
            reason.
        below: agreement below which there is doubt; 1 doubts all.
    """
    return agreement < below or below == agreement == 1.0


def explained_share(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> float:
    """Share in [0,1] of what these edges measured that agrees with poses and depths.

    Weighted by confidence and gate; 1 where nothing was measured.

    Args:
        rows: of the graph.
        gates: [N,h,w] in [0,1] of all keyframes.
    """
    return float(agreeing_share(*_apart(store, graph, rows, gates), _SCALE, nothing=1.0))


def explained_weight(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> Tensor:
    """Weight of what each of these edges measured that agrees with poses and depths, [E].

    Args:
        rows, gates: as of `explained_share`.
    """
    return agreeing_weight(*_apart(store, graph, rows, gates), _SCALE).sum((1, 2))


def explained_around(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> Tensor:
    """Share in [0,1] of what the edges of each keyframe measured that agrees, [N] on the CPU.

    Of those from it and to it; 0 of a keyframe about which nothing was measured.

    Args:
        rows, gates: as of `explained_share`.
    """
    edges = _sums_of_edges(store, graph, rows, gates)
    totals = edges.new_zeros(2, len(store))
    for ends in graph.index(rows):
        totals.index_add_(1, ends.cpu(), edges)
    return totals[0] / totals[1].clamp_min(1e-6)


def explained_across(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> Tensor:
    """Share in [0,1] of what was measured across each interval that agrees, [N-1] on the CPU.

    Of the edges that lead from before an interval between keyframes to behind it; 1 where these
    measured nothing. All edges together do not tell where a path has broken: its pieces are sound,
    each by itself.

    Args:
        rows, gates: as of `explained_share`.
    """
    edges = _sums_of_edges(store, graph, rows, gates)
    ii, jj = (ends.cpu() for ends in graph.index(rows))
    steps = edges.new_zeros(2, len(store))
    steps.index_add_(1, torch.minimum(ii, jj), edges)
    steps.index_add_(1, torch.maximum(ii, jj), -edges)
    agree, known = steps.cumsum(1)[:, :-1]
    return torch.where(known > 1e-6, agree / known.clamp_min(1e-6), 1.0).clamp(0.0, 1.0)


def weakest_link(store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor) -> Link:
    """Where least agrees of what was measured across it; unknown without an interval.

    Args:
        rows, gates: as of `explained_share`.
    """
    if len(store) < 2:
        return Link()
    share, at = explained_across(store, graph, rows, gates).min(dim=0)
    return Link(float(share), store.infos[int(at)].index)


def explained_reach(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> float:
    """Share of what was measured that agrees, times how far it reaches over the picture, in [0,1].

    What the camera moves against surrounds what moves by itself. Where a large object has much of
    what is matched, as much may agree with its motion as with the camera's, but on less of the
    picture: the area of the ellipse that cells scatter in, as a share of that of all matched ones.

    Args:
        rows, gates: as of `explained_share`.
    """
    ii, _ = graph.index(rows)
    matched = graph.confidence[rows][..., :2].mean(-1) * gates[ii]
    agreeing = agreeing_weight(*_apart(store, graph, rows, gates), _SCALE).sum(0).double()
    total = matched.sum(0).double()
    share = float(agreeing.sum() / total.sum().clamp_min(1e-6))
    around = scatter(total)
    return share * min(1.0, scatter(agreeing) / around) if around > 0 else 0.0


def scatter(weight: Tensor) -> float:
    """Area of the ellipse that weights [h,w] scatter in, up to a factor, in cells."""
    height, width = weight.shape
    place = pixel_grid(height, width, weight.dtype, weight.device).flatten(0, 1).T
    part = weight.flatten() / weight.sum().clamp_min(1e-6)
    off = place - (place * part).sum(1, keepdim=True)
    return float(torch.linalg.det((off * part) @ off.T).clamp_min(0).sqrt())


def _sums_of_edges(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> Tensor:
    """Sums over each edge of what agrees and of what was measured, [2,E] float64 on the CPU."""
    parts = agreeing_and_known(*_apart(store, graph, rows, gates), _SCALE)
    return torch.stack(parts).sum((2, 3)).cpu().double()


def _apart(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> tuple[Tensor, Tensor]:
    """How far each measured place is from the predicted one, and its weight; both [E,h,w]."""
    ii, jj = graph.index(rows)
    place, valid = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
    weight = graph.confidence[rows][..., :2].mean(-1) * gates[ii] * valid
    return vector_norm(graph.target[rows] - place, dim=-1), weight
