"""Brings the similarities of any features to one scale, by what they are at measured matches.

The gate and the thresholds of the objective are fixed numbers, and the cosine of one extractor is
not that of another. What is alike for all is the footage: where correspondence measured a match,
the two cells show the same point, whether it stands still or moves. So the dissimilarities
`d = 1 - cosine` at the matches say what "consistent" is with these features, and the map

    d' = MEDIAN (d / m)^g,    g = log(QUARTILE / MEDIAN) / log(q / m)

takes their median m to `MEDIAN` and their quartile q, which three matches of four stay below, to
`QUARTILE`. It is increasing: it changes no order of cells, and nothing that can be told apart.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from droidw.geometry.transfer import on_device, upload
from droidw.interfaces.uncertainty import UncertaintyView
from droidw_plugins.uncertainty import _objective as objective

__all__ = ["MEDIAN", "QUARTILE", "MatchScale", "matches", "weighted_quantiles"]

MEDIAN = 0.07
QUARTILE = 0.105
"""Dissimilarities that half and three quarters of the matches stay below: those of `cnn`, with
which the gate lets three quarters of what stands still through (docs/features.md)."""
_LEAST = 1e-5
"""A median below this is rounding: the features are the same everywhere and tell nothing."""
_POWERS = (0.25, 4.0)
_ENOUGH = 100.0
"""Matches, counted by their weight, that a look needs."""
_MEMORY = 64
"""Looks that the running mean holds."""
_EDGES = 16
"""Edges whose matches are looked at in one step."""


class MatchScale:
    """Running quartile and median of the dissimilarity of matches, and the map made from them.

    Attributes:
        looks: how many sets of matches have been seen; the map is the identity before the first.
        quartile, median: of the dissimilarity, geometric means over the looks.
    """

    def __init__(self) -> None:
        self.looks = 0
        self.quartile = self.median = 1.0

    def look(self, cosine: Tensor, weight: Tensor) -> None:
        """Take in one set of matches, if there are enough of them.

        Args:
            cosine: of any shape. weight: >= 0, the same shape; 0 where nothing was matched.
        """
        weight = torch.where(torch.isfinite(weight) & torch.isfinite(cosine), weight, 0.0)
        if not weight.numel():
            return
        quantiles = weighted_quantiles(1.0 - cosine, weight, (0.75, 0.5))
        told = torch.cat([torch.stack([weight.max(), weight.sum()]).double(), quantiles.double()])
        largest, total, quartile, median = told.tolist()
        if largest <= 0 or total / largest < _ENOUGH:
            return
        if median < _LEAST:
            return
        self.looks += 1
        share = 1.0 / min(self.looks, _MEMORY)
        self.quartile *= (quartile / self.quartile) ** share
        self.median *= (median / self.median) ** share

    def __call__(self, cosine: Tensor) -> Tensor:
        """The calibrated cosine, of the same shape; 1 stays 1."""
        if not self.looks:
            return cosine
        ratio = math.log(max(self.quartile / self.median, 1.0 + 1e-9))
        power = min(max(math.log(QUARTILE / MEDIAN) / ratio, _POWERS[0]), _POWERS[1])
        apart = (1.0 - cosine).clamp_min(0.0).div_(self.median)
        return 1.0 - MEDIAN * apart.pow_(power)

    def state_dict(self) -> dict[str, Any]:
        """`matches` [3] float64: looks, quartile and median; empty before the first look."""
        if not self.looks:
            return {}
        numbers = [self.looks, self.quartile, self.median]
        return {"matches": torch.tensor(numbers, dtype=torch.float64)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`."""
        found = state.get("matches")
        looks, self.quartile, self.median = (0, 1.0, 1.0) if found is None else found.tolist()
        self.looks = int(looks)


def matches(
    view: UncertaintyView, used: Tensor, first: int
) -> tuple[objective.Samples, Tensor] | None:
    """Where correspondence measured the cells of some edges, and how surely.

    Args:
        used: [E] bool on the host, edges that may be taken. first: keyframe from which rows count.
    Returns:
        Samples of n edges, and weights [n,P], 0 outside the grid; None where no edge is used.
    """
    edges = used.nonzero()[:, 0]
    if not len(edges):
        return None
    # Every n-th: a few edges tell the quantiles well enough.
    edges = upload(edges[:: -(-len(edges) // _EDGES)].contiguous(), view.disps.device)
    xy = view.target[edges].flatten(1, 2).transpose(1, 2).contiguous()
    weight = view.confidence[edges, ..., :2].mean(-1).flatten(1)
    width = view.disps.shape[2]
    ii, jj = view.ii[edges] - first, view.jj[edges] - first
    samples = objective.make_samples(xy, weight > 0, width, ii, jj)
    return samples, weight * samples.inside


def weighted_quantiles(values: Tensor, weights: Tensor, shares: tuple[float, ...]) -> Tensor:
    """Smallest values [n] below or at which each share of the whole weight lies.

    Args:
        values, weights: of one shape; a weight of 0 leaves its value out.
    """
    ordered, order = values.flatten().sort()
    reached = weights.flatten()[order].double().cumsum(0)
    wanted = reached[-1] * on_device(shares, reached.device, reached.dtype)
    return ordered[torch.searchsorted(reached, wanted).clamp_max_(len(ordered) - 1)]
