"""Whether tracking holds: how much of the measured motion the poses explain."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor
from torch.linalg import vector_norm

from droidw.geometry.projective import reproject
from droidw.solve.weights import agreeing_share, agreeing_weight

if TYPE_CHECKING:
    from droidw.graph.factors import FactorGraph
    from droidw.graph.store import KeyframeStore

__all__ = ["doubtful", "explained_share", "explained_weight"]

# Distance of measured and predicted place, in cells, at which they agree by half.
_SCALE = 0.2


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


def _apart(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> tuple[Tensor, Tensor]:
    """How far each measured place is from the predicted one, and its weight; both [E,h,w]."""
    ii, jj = graph.index(rows)
    place, valid = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
    weight = graph.confidence[rows][..., :2].mean(-1) * gates[ii] * valid
    return vector_norm(graph.target[rows] - place, dim=-1), weight
