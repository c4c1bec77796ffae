"""From confidence and uncertainty to the weights of bundle adjustment (REFERENCE 3.1).

And what they weigh: how much of the measured motion agrees with the poses.

Bundle adjustment never sees an uncertainty: it gets `confidence x gate x validity`, and less where
a match is far from what the poses predict.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import torch
from torch.nn import functional as F

from droidw.geometry.transfer import on_device

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "CLOSED",
    "GateKind",
    "agreeing_and_known",
    "agreeing_share",
    "agreeing_weight",
    "closed_share",
    "gate",
    "half_open",
    "opened",
    "parting",
    "residual_weights",
    "unmasked",
]

GateKind = Literal["rational", "inverse", "none"]

CLOSED = 0.5
"""What keeps less than this share of its weight is called closed, by a gate or by a mask."""

_BINS = 256
# A part of two has at least so large a share; two say far more than one from so much less error on.
_LEAST_PART, _FAR_MORE = 0.005, 0.25
# Smaller uncertainties are as good as this one: their logarithms would be all that parts.
_LEAST_PARTED = 0.05


def gate(
    u: Tensor,
    kind: GateKind = "rational",
    slope: float = 45.0,
    shift: float = 35.0,
    floor: float = 0.1,
    closed_below: float = 0.0,
) -> Tensor:
    """Share in [0,1] of its weight that a cell of uncertainty `u` keeps; 1 where `u` is 0.

    A `u` that is not finite gets 0: what cannot be judged is not trusted.

    Args:
        u: any shape, >= 0.
        kind: "rational" is `1 / max(slope * u - shift, floor)` as in the published code (1 up to
            u = (1 + shift) / slope = 0.8 with the defaults); "inverse" is `1 / u` as in the
            paper; both clamped to [0,1]. "none" is 1 everywhere.
        slope, shift, floor: of the rational gate; floor > 0.
        closed_below: a share that would be less is 0. Neither form comes to 0 by itself.
    Returns:
        The same shape, dtype and device.
    Raises:
        ValueError: `kind` is none of the three, or `floor` is not positive.
    """
    if kind == "none":
        return torch.ones_like(u)
    if kind == "rational":
        if floor <= 0:
            raise ValueError(f"the floor of the rational gate must be positive, not {floor}")
        weight = (slope * u - shift).clamp_min(floor).reciprocal().clamp(0.0, 1.0)
    elif kind == "inverse":
        # Clamping below at 1 is the clamp of the weight at 1, without a division by zero.
        weight = u.clamp_min(1.0).reciprocal()
    else:
        raise ValueError(f"no gate is called {kind!r}; valid: rational, inverse, none")
    keeps = torch.isfinite(u) & (weight >= closed_below)
    return torch.where(keeps, weight, torch.zeros_like(weight))


def half_open(kind: GateKind = "rational", slope: float = 45.0, shift: float = 35.0) -> float:
    """The uncertainty that `gate` leaves half of its weight; infinite for "none"."""
    if kind == "none":
        return math.inf
    return (2.0 + shift) / slope if kind == "rational" else 2.0


def parting(u: Tensor) -> float:
    """The uncertainty at which all of these part best in two.

    By the least error of two normal distributions of log u (Kittler and Illingworth 1986), which
    allows for a few that are far off, if they say far more of log u than a single one; else by
    the most variance between both parts (Otsu 1979).

    Args:
        u: any shape, >= 0; what is not finite does not count.
    Returns:
        A value between the least and the largest; 0 where all are alike.
    """
    u = u.cpu()  # a GPU waits once
    logs = u[torch.isfinite(u)].clamp_min(_LEAST_PARTED).log()
    if not logs.numel():
        return 0.0
    low, high = (float(end) for end in logs.aminmax())
    if low == high:
        return 0.0
    counts = torch.histc(logs, _BINS, low, high).double()
    shares, places = counts / counts.sum(), torch.arange(_BINS, dtype=torch.float64)
    moments = [(shares * places**k).cumsum(0) for k in range(3)]
    # neither side is empty: the least value is in the first bin and the largest in the last
    p, mean, spread = _moments([m[:-1] for m in moments])
    q, far_mean, far_spread = _moments([m[-1] - m[:-1] for m in moments])
    error = p * (spread.log() - 2 * p.log()) + q * (far_spread.log() - 2 * q.log())
    error = torch.where(torch.minimum(p, q) < _LEAST_PART, math.inf, error)
    alone = float(_moments([m[-1] for m in moments])[2].log())
    two = float(error.min()) < alone - _FAR_MORE
    score = -error if two else p * q * (far_mean - mean) ** 2
    # an empty stretch parts the same anywhere: in its middle
    best = float((score >= score.max() - 1e-9 * score.max().abs()).nonzero().double().mean())
    return math.exp(low + (high - low) * (best + 1) / _BINS)


def _moments(m: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Share, mean and variance (of one bin at least) from sums of the powers 0 to 2."""
    mean = m[1] / m[0]
    return m[0], mean, (m[2] / m[0] - mean**2).clamp_min(1 / 12)


def opened(
    u: Tensor, share: float, kind: GateKind = "rational", slope: float = 45.0, shift: float = 35.0
) -> Tensor:
    """Uncertainties such that `gate` leaves at least `share` of each map its whole weight.

    What looks like that which moves is closed with it, and where that is most of a picture, poses
    follow the corner that is left. Most of what is seen stands still: where too little of a map is
    small enough, all of it is divided by what makes it so.

    Args:
        u: [n,h,w] >= 0.
        share: in [0,1]; 0 leaves `u` as it is.
        kind, slope, shift: of the gate.
    Returns:
        [n,h,w]; a fresh tensor unless nothing is to be done.
    """
    if share == 0 or kind == "none" or not u.numel():
        return u
    whole = (1.0 + shift) / slope if kind == "rational" else 1.0
    maps = u.flatten(1)
    most = maps.kthvalue(max(1, math.ceil(share * maps.shape[1])), dim=1).values
    factor = torch.where(torch.isfinite(most), whole / most, 1.0).clamp_max(1.0)
    return u * factor[:, None, None]


def unmasked(covered: Tensor) -> Tensor:
    """Share in [0,1] that a user's mask leaves of each cell and of the cells around it, [h,w].

    A match is made with what surrounds its cell: beside what is masked it follows that in part.

    Args:
        covered: [h,w] share of each cell that the mask covers, in [0,1].
    """
    return 1.0 - F.max_pool2d(covered[None], kernel_size=3, stride=1, padding=1)[0]


def residual_weights(
    confidence: Tensor,
    valid: Tensor | None,
    gates: Tensor | None,
    ii: Tensor,
    jj: Tensor,
    target: Tensor,
    bidirectional: bool = False,
    scale: float = 1.0,
) -> Tensor:
    """Weights of all residuals: `scale * confidence * gate of the source * validity`.

    Args:
        confidence: [E,h,w,2] or [E,h,w,3], the information of a match as in `EdgeUpdate`.
        valid: [E,h,w] bool, or None where every cell is valid.
        gates: [N,h,w] in [0,1] from `gate`, or None to leave uncertainty out.
        ii, jj: [E] int64 into `gates`.
        target: [E,h,w,2] measured position in frame j, cells; only read when `bidirectional`.
        bidirectional: multiply by the gate of frame j too, interpolated at `target` where that
            lies inside the grid (off in the published system).
        scale: factor on the confidence (0.001 for the published network's).
    Returns:
        The shape of `confidence`, a fresh tensor; confidences that are not finite stay so, for
        bundle adjustment counts and drops them.
    """
    weight = confidence * scale
    if gates is not None:
        factor = gates[ii]
        if bidirectional:
            factor = factor * _gate_at(gates[jj], target)
        weight = weight * factor[..., None].to(weight.dtype)
    if valid is not None:
        weight = weight * valid[..., None].to(weight.dtype)
    return weight


def agreeing_share(residual: Tensor, weight: Tensor, scale: float, nothing: float = 0.0) -> Tensor:
    """Mean of `1 / (1 + (r / scale)^2)`, in [0,1]: how much of what was measured agrees.

    Args:
        residual: distance of measured and predicted place, cells. weight: >= 0, the same shape;
            where either is not finite, nothing was measured.
        scale: distance at which a measurement agrees by half, cells.
        nothing: the answer where all weights are 0.
    Returns:
        A scalar on the device.
    """
    left, known = agreeing_and_known(residual, weight, scale)
    agreeing, total = left.sum(), known.sum()
    return torch.where(total > 0, agreeing / total.clamp_min(1e-6), nothing)


def agreeing_weight(residual: Tensor, weight: Tensor, scale: float) -> Tensor:
    """What `1 / (1 + (r / scale)^2)` leaves of each weight; 0 where nothing was measured.

    Args:
        residual, weight, scale: as of `agreeing_share`.
    """
    return agreeing_and_known(residual, weight, scale)[0]


def closed_share(gates: Tensor) -> float:
    """Share of all cells that are closed, by uncertainty or a mask."""
    return float((gates < CLOSED).float().mean())


def agreeing_and_known(residual: Tensor, weight: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """What is left of each weight, and the weight itself; both 0 where nothing was measured.

    Args:
        residual, weight, scale: as of `agreeing_share`.
    """
    known = torch.isfinite(residual) & torch.isfinite(weight)
    weight = torch.where(known, weight, 0.0)
    apart = torch.where(known, residual, 0.0)
    return weight / (1.0 + (apart / scale).square_()), weight


def _gate_at(gates: Tensor, target: Tensor) -> Tensor:
    """Gates [E,h,w] interpolated at targets [E,h,w,2]; 1 where these lie outside the grid."""
    height, width = gates.shape[-2:]
    x, y = target.unbind(-1)
    # A comparison with NaN is false, so that a broken target counts as outside.
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    size = on_device([max(width - 1, 1), max(height - 1, 1)], target.device, target.dtype)
    where = torch.where(inside[..., None], target / size * 2 - 1, torch.zeros_like(target))
    found = F.grid_sample(
        gates[:, None], where.to(gates.dtype), padding_mode="border", align_corners=True
    )[:, 0]
    return torch.where(inside, found, torch.ones_like(found))
