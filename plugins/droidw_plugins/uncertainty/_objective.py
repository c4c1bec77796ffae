"""The consistency objective: loss, prior and analytic gradients (REFERENCE 4.3, paper eq. of E_uncer).

For an edge i -> j and a cell p of i, projected with the current pose and depth to q in j:
`e = (1 - s) / (u_i u_ij)`, where `s` is the cosine of the features and `u_ij` the uncertainty of j,
both interpolated at q. The prior is `log(u + 1)` per cell. Gradients flow to u of i directly and to
u of j through the adjoint of the interpolation, a scatter onto the four neighbours of q.

Everything works on rows: a map [K,h,w] is a table [K*h*w], and a sample is four rows with weights.
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


@dataclass(frozen=True)
class Samples:
    """The P pairs (cell of i, place in j) that fall inside the grid of j.

    Attributes:
        source: [P] row of the cell of i in a table [K*h*w].
        corners: [P,4] rows of the four neighbours of the place in j.
        weights: [P,4] bilinear weights, which add up to one.
    """

    source: Tensor
    corners: Tensor
    weights: Tensor


def edges_used(ii: Tensor, jj: Tensor, min_gap: int) -> Tensor:
    """Mask [E] of edges between frames at least `min_gap` keyframes apart."""
    return (ii - jj).abs() >= min_gap


def make_samples(coords: Tensor, valid: Tensor, ii: Tensor, jj: Tensor) -> Samples:
    """Samples of all cells that project in front of the camera and into the grid of j.

    Args:
        coords: [E,h,w,2] place in j, cells, x then y. valid: [E,h,w] bool.
        ii, jj: [E] rows of the frames in a stack [K,h,w].
    """
    height, width = coords.shape[1:3]
    x, y = coords.unbind(-1)
    inside = valid & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    edge, cell = inside.flatten(1).nonzero(as_tuple=True)
    x, y = x[inside], y[inside]
    # The last row and column are reached with weight 1 from their left and upper neighbour.
    left = x.floor().clamp_(0, max(width - 2, 0))
    top = y.floor().clamp_(0, max(height - 2, 0))
    a, b = x - left, y - top
    first = jj[edge] * (height * width) + top.long() * width + left.long()
    right, below = (1 if width > 1 else 0), (width if height > 1 else 0)
    steps = first.new_tensor([0, right, below, below + right])
    weights = torch.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], dim=1)
    return Samples(ii[edge] * (height * width) + cell, first[:, None] + steps, weights)


def interpolate(table: Tensor, samples: Samples) -> Tensor:
    """Bilinear values [P] of a table [K*h*w]."""
    return (table[samples.corners] * samples.weights).sum(1)


def scatter(values: Tensor, samples: Samples, rows: int) -> Tensor:
    """The adjoint of `interpolate`: spread values [P] onto a table [rows]."""
    spread = (samples.weights * values[:, None]).flatten()
    return values.new_zeros(rows).index_add_(0, samples.corners.flatten(), spread)


def similarity(features: Tensor, samples: Samples) -> Tensor:
    """Cosine [P] between the feature of the cell and the interpolated one, in [-1,1].

    Args:
        features: [K*h*w,C], raw; the interpolated vector is normalised, not its neighbours.
    """
    # A weighted embedding bag is a bilinear gather that never stores the four neighbours.
    there = F.embedding_bag(
        samples.corners, features, mode="sum",
        per_sample_weights=samples.weights.to(features.dtype),
    )
    here = features[samples.source]
    dot = (here * there).sum(1)
    length = here.norm(dim=1) * there.norm(dim=1)
    return dot / (length + _EPSILON)


def residual(cosine: Tensor, threshold: float) -> Tensor:
    """`1 - s` with s the cosine clamped to [0,1], and 0 unless it exceeds the threshold."""
    kept = cosine.clamp(0.0, 1.0)
    return 1.0 - torch.where(kept > threshold, kept, torch.zeros_like(kept))


def pair_energy(u: Tensor, rho: Tensor, samples: Samples, decoupled: bool = True) -> Tensor:
    """Sum over all pairs of `rho / (u_i u_ij)`, or of `rho / u_i^2` where not decoupled.

    Args:
        u: [K*h*w] > 0. rho: [P] from `residual`.
    """
    here = u[samples.source]
    there = interpolate(u, samples) if decoupled else here
    return (rho / (here * there)).sum()


def pair_gradient(
    u: Tensor, rho: Tensor, samples: Samples, decoupled: bool = True
) -> tuple[Tensor, Tensor]:
    """Gradient [K*h*w] of `pair_energy` with respect to u, and the energy itself (a scalar)."""
    here = u[samples.source]
    if not decoupled:
        energy = rho / (here * here)
        return u.new_zeros(u.shape).index_add_(0, samples.source, -2 * energy / here), energy.sum()
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
