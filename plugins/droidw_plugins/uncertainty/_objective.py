"""The consistency objective: loss, prior and analytic gradients (REFERENCE 4.3, paper eq. E_uncer).

For an edge i -> j and a cell p of i, projected with the current pose and depth to q in j:
`e = (1 - s) / (u_i u_ij)`, where `s` is the cosine of the features and `u_ij` the uncertainty of j,
both interpolated at q. The prior is `log(u + 1)` per cell. Gradients flow to u of i directly and to
u of j through the adjoint of the interpolation, a scatter onto the four neighbours of q.

Everything is dense: pairs that fall outside keep their place and get the residual 0, which is
cheaper than to pick out the rest. K keyframes have P = h*w cells each; tables have K*P rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = [
    "Samples",
    "edges_used",
    "frame_gradient",
    "interpolate",
    "make_samples",
    "pair_energy",
    "pair_gradient",
    "residual",
    "scatter",
    "similarity",
    "softplus",
    "softplus_slope",
]

_EPSILON = 1e-6
# Feature values handled at a time on a CPU: the temporaries then stay in its cache.
_CHUNK = 1 << 18


@dataclass(frozen=True)
class Samples:
    """Where the cells of frame i fall in frame j, for E edges.

    Attributes:
        source: [E] frame i, row of a stack [K,P].
        corners: [E*P,4] int32 rows of the four neighbours of the place in j, in a table [K*P].
        weights: [E*P,4] bilinear weights, which add up to one.
        inside: [E,P] bool, in front of the camera and within the grid; elsewhere corners and
            weights are those of the nearest cell, and meaningless.
    """

    source: Tensor
    corners: Tensor
    weights: Tensor
    inside: Tensor


def edges_used(ii: Tensor, jj: Tensor, min_gap: int) -> Tensor:
    """Mask [E] of edges between frames at least `min_gap` keyframes apart."""
    return (ii - jj).abs() >= min_gap


def make_samples(coords: Tensor, valid: Tensor, ii: Tensor, jj: Tensor) -> Samples:
    """Samples of the cells of frames ii in frames jj.

    Args:
        coords: [E,h,w,2] place in j, cells, x then y. valid: [E,h,w] bool.
        ii, jj: [E] rows of the frames in a stack [K,h,w].
    """
    height, width = coords.shape[1:3]
    x, y = coords.flatten(1, 2).unbind(-1)
    inside = valid.flatten(1) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x = torch.nan_to_num(x).clamp(0, width - 1)
    y = torch.nan_to_num(y).clamp(0, height - 1)
    # The last row and column are reached with weight 1 from their left and upper neighbour.
    left = x.floor().clamp_(max=max(width - 2, 0))
    top = y.floor().clamp_(max=max(height - 2, 0))
    a, b = x - left, y - top
    first = (top * width + left).to(torch.int32) + (jj * (height * width)).to(torch.int32)[:, None]
    right, below = (1 if width > 1 else 0), (width if height > 1 else 0)
    steps = first.new_tensor([0, right, below, below + right])
    ab = a * b
    weights = torch.stack([1 - a - b + ab, a - ab, b - ab, ab], dim=-1)
    corners = (first[..., None] + steps).view(-1, 4)
    return Samples(ii, corners, weights.view(-1, 4), inside)


def interpolate(table: Tensor, samples: Samples) -> Tensor:
    """Bilinear values [E,P] of a stack [K,P]."""
    found = table.flatten().index_select(0, samples.corners.flatten()).view(-1, 4)
    return (found * samples.weights).sum(1).view(samples.inside.shape)


def scatter(values: Tensor, samples: Samples, frames: int) -> Tensor:
    """The adjoint of `interpolate`: spread values [E,P] onto a stack [K,P] of `frames` frames."""
    cells = samples.inside.shape[1]
    spread = (samples.weights * values.reshape(-1, 1)).flatten()
    out = values.new_zeros(frames * cells)
    return out.index_add_(0, samples.corners.flatten(), spread).view(frames, cells)


def similarity(features: Tensor, samples: Samples) -> Tensor:
    """Cosine [E,P] between the feature of the cell and the interpolated one, in [-1,1].

    Args:
        features: [K,P,C], raw; the interpolated vector is normalised, not its neighbours.
    """
    n_edges, cells = samples.inside.shape
    channels = features.shape[2]
    table = features.reshape(-1, channels)
    weights = samples.weights.to(features.dtype)
    found = features.new_empty(n_edges, cells)
    step = n_edges if features.is_cuda else max(_CHUNK // (cells * channels), 1)
    for start in range(0, n_edges, step):
        part = slice(start, min(start + step, n_edges))
        rows = slice(part.start * cells, part.stop * cells)
        here = features.index_select(0, samples.source[part])
        # A weighted embedding bag is a bilinear gather that never stores the four neighbours.
        there: Tensor = F.embedding_bag(
            samples.corners[rows], table, mode="sum", per_sample_weights=weights[rows]
        ).view(-1, cells, channels)
        length = here.norm(dim=2) * there.norm(dim=2)
        dot = here.mul_(there).sum(dim=2)
        found[part] = dot / (length + _EPSILON)
    return found


def residual(cosine: Tensor, samples: Samples, threshold: float) -> Tensor:
    """`1 - s` with s the cosine clamped to [0,1], and 0 unless it exceeds the threshold.

    Returns:
        [E,P]; 0 for pairs that are not inside, so that they take no part.
    """
    kept = cosine.clamp(0.0, 1.0)
    rho = 1.0 - torch.where(kept > threshold, kept, torch.zeros_like(kept))
    return rho * samples.inside


def pair_energy(u: Tensor, rho: Tensor, samples: Samples, decoupled: bool = True) -> Tensor:
    """Sum over all pairs of `rho / (u_i u_ij)`, or of `rho / u_i^2` where not decoupled.

    Args:
        u: [K,P] > 0. rho: [E,P] from `residual`.
    """
    here = u[samples.source]
    there = interpolate(u, samples) if decoupled else here
    return (rho / (here * there)).sum()


def pair_gradient(
    u: Tensor, rho: Tensor, samples: Samples, decoupled: bool = True
) -> tuple[Tensor, Tensor]:
    """Gradient [K,P] of `pair_energy` with respect to u, and the energy itself (a scalar)."""
    here = u[samples.source]
    if not decoupled:
        energy = rho / (here * here)
        return torch.zeros_like(u).index_add_(0, samples.source, -2 * energy / here), energy.sum()
    there = interpolate(u, samples)
    energy = rho / (here * there)
    gradient = scatter(-energy / there, samples, u.shape[0])
    return gradient.index_add_(0, samples.source, -energy / here), energy.sum()


def frame_gradient(
    pair: Tensor, u: Tensor, counts: Tensor, gamma_data: float, gamma_prior: float
) -> Tensor:
    """J of REFERENCE 4.3: the pair gradient per edge of the frame, plus that of the prior.

    Because every frame has its own factor, this is not the gradient of one scalar energy.

    Args:
        pair, u: [K,h,w]. counts: [K] number of edges in which a frame takes part.
    """
    share = gamma_data / (counts.to(u.dtype) + _EPSILON)
    return share[:, None, None] * pair + gamma_prior / (u + 1.0)


def softplus(y: Tensor, offset: float) -> Tensor:
    """`log(1 + offset + e^y)`: the published map from y to uncertainty (paper: offset 0)."""
    # log(1 + offset) + log(1 + e^(y - log(1 + offset))), which does not overflow
    shift = torch.log1p(torch.tensor(offset, dtype=torch.float64)).item()
    return shift + F.softplus(y - shift)


def softplus_slope(y: Tensor, offset: float) -> Tensor:
    """Derivative of `softplus`: `1 / (1 + (1 + offset) e^-y)`."""
    shift = torch.log1p(torch.tensor(offset, dtype=torch.float64)).item()
    return torch.sigmoid(y - shift)
