"""Whether tracking holds: how much of the measured motion the poses explain."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor
from torch.linalg import vector_norm

from droidw.geometry.projective import reproject
from droidw.solve.weights import agreeing_share

if TYPE_CHECKING:
    from droidw.graph.factors import FactorGraph
    from droidw.graph.store import KeyframeStore

__all__ = ["doubtful", "explained_share"]

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
    ii, jj = graph.index(rows)
    place, valid = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
    weight = graph.confidence[rows][..., :2].mean(-1) * gates[ii] * valid
    apart = vector_norm(graph.target[rows] - place, dim=-1)
    return float(agreeing_share(apart, weight, _SCALE, nothing=1.0))
