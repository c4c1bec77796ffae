"""Whether tracking holds: how much of the measured motion the poses explain."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor
from torch.linalg import vector_norm

from droidw.geometry.projective import reproject

if TYPE_CHECKING:
    from droidw.graph.factors import FactorGraph
    from droidw.graph.store import KeyframeStore

__all__ = ["agreeing_share"]

# Distance of measured and predicted place, in cells, at which they agree by half.
_SCALE = 0.2


def agreeing_share(
    store: KeyframeStore, graph: FactorGraph, rows: list[int], gates: Tensor
) -> float:
    """Share in [0,1] of what these edges measured that agrees with poses and depths.

    It is the mean of `1 / (1 + (r / 0.2)^2)`, r in cells, weighted by confidence and gate; 1 where
    nothing was measured.

    Args:
        rows: of the graph.
        gates: [N,h,w] in [0,1] of all keyframes.
    """
    ii, jj = graph.index(rows)
    place, valid = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
    target, confidence = graph.target[rows], graph.confidence[rows]
    weight = (confidence[..., :2].mean(-1) * gates[ii] * valid).nan_to_num(0.0)
    apart = vector_norm(target - place, dim=-1).nan_to_num(1e3)
    agreeing = (weight / (1.0 + (apart / _SCALE).square())).sum()
    total = weight.sum()
    return float(agreeing / total) if float(total) > 0 else 1.0
