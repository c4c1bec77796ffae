"""The consistency objective: loss, prior and analytic gradients (REFERENCE 4.3, paper eq. E_uncer).

For an edge i -> j and a cell p of i, projected with the current pose and depth to q in j:
`e = (1 - s) / (u_i u_ij)`, where `s` is the cosine of the features and `u_ij` the uncertainty of j,
both interpolated at q. The prior is `log(u + 1)` per cell. Gradients flow to u of i directly and to
u of j through the adjoint of the interpolation, a scatter onto the four neighbours of q.

Everything is dense: pairs that fall outside keep their place and get the residual 0, which is
cheaper than to pick out the rest. K keyframes have P = h*w cells each; tables have K*P rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.geometry import se3
from droidw.geometry.projective import NEAR, pixel_grid, relative_pose
from droidw.geometry.transfer import on_device

__all__ = [
    "EPSILON",
    "Samples",
    "calibrated",
    "edges_used",
    "frame_gradient",
    "interpolate",
    "make_samples",
    "motions",
    "neighbours",
    "pair_energy",
    "pair_gradient",
    "project",
    "residual",
    "scatter",
    "similarity",
    "softplus",
    "softplus_slope",
]

EPSILON = 1e-6
"""Keeps the cosine of a feature that is zero, and the share of a frame without edges, finite."""
# Feature values handled at a time on a CPU: the temporaries then stay in its cache.
_CHUNK = 1 << 18
# Cells of all edges that are compared at once on a GPU; bounds memory, not the result.
_TOGETHER = 300_000


@dataclass(frozen=True)
class Samples:
    """Where the cells of frame i fall in frame j, for E edges.

    Attributes:
        source: [E] frame i, row of a stack [K,P].
        place: [E,2,P] place in j, row of x then row of y, moved to the border where it is outside.
        first: [E*P] upper left of the four neighbours of the place in j, row of a table [K*P].
        steps: from there to the upper left, upper right, lower left and lower right neighbour.
        weights: [4,E*P] their bilinear weights, which add up to one.
        inside: [E,P] bool, in front of the camera and within the grid.
    """

    source: Tensor
    place: Tensor
    first: Tensor
    steps: tuple[int, int, int, int]
    weights: Tensor
    inside: Tensor

    def of(self, edges: Tensor) -> Samples:
        """Those of some edges: mask [E] or indices."""
        n_edges, cells = self.inside.shape
        return Samples(
            self.source[edges],
            self.place[edges],
            self.first.view(n_edges, cells)[edges].flatten(),
            self.steps,
            self.weights.view(4, n_edges, cells)[:, edges].flatten(1),
            self.inside[edges],
        )


def neighbours(height: int, width: int) -> tuple[int, int, int, int]:
    """`Samples.steps` of a grid; a grid of one row or column has no neighbours that way."""
    right, below = (1 if width > 1 else 0), (width if height > 1 else 0)
    return 0, right, below, below + right


def edges_used(ii: Tensor, jj: Tensor, min_gap: int) -> Tensor:
    """Mask [E] of edges between frames at least `min_gap` keyframes apart."""
    return (ii - jj).abs() >= min_gap


def motions(T_cw: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor) -> tuple[Tensor, Tensor]:
    """Turn [E,3,3] and shift [E,3] that take cells of frame i to frame j.

    `turn (x, y, 1) + shift d` is `(x' Z, y' Z, Z)`, with d the disparity of the cell and Z its
    relative depth in frame j.

    Args:
        T_cw: [N,7]. intrinsics: [4] of the grid. ii, jj: [E].
    """
    fx, fy, cx, cy = intrinsics.to(T_cw.dtype).unbind()
    o, one = torch.zeros_like(fx), torch.ones_like(fx)
    K = torch.stack([fx, o, cx, o, fy, cy, o, o, one]).view(3, 3)
    K_inv = torch.stack([1 / fx, o, -cx / fx, o, 1 / fy, -cy / fy, o, o, one]).view(3, 3)
    G = relative_pose(T_cw, ii, jj)
    return K @ se3.rotation(G) @ K_inv, G[:, :3] @ K.T


def project(
    T_cw: Tensor, disps: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor
) -> tuple[Tensor, Tensor]:
    """What `droidw.geometry.projective.reproject` gives, x and y apart, which is cheaper here.

    Args:
        T_cw: [N,7]. disps: [N,h,w]. intrinsics: [4] of the grid. ii, jj: [E].
    Returns:
        xy [E,2,P] in cells, and valid [E,P], not too near the camera.
    """
    h, w = disps.shape[1:]
    turn, shift = motions(T_cw, intrinsics, ii, jj)
    turn, shift = turn.to(disps.dtype), shift.to(disps.dtype)
    pixels = pixel_grid(h, w, disps.dtype, disps.device).view(-1, 2).T
    pixels = torch.cat([pixels, torch.ones_like(pixels[:1])])
    points = (turn.view(-1, 3) @ pixels).view(len(ii), 3, h * w)
    points.addcmul_(shift[:, :, None], disps.flatten(1).index_select(0, ii)[:, None])
    near = points[:, 2]
    scale = near.clamp_min(NEAR).reciprocal_()
    return points[:, :2] * scale[:, None], near >= NEAR


def make_samples(xy: Tensor, valid: Tensor, width: int, ii: Tensor, jj: Tensor) -> Samples:
    """Samples of the cells of frames ii in frames jj.

    Args:
        xy: [E,2,P] place in j, cells, row of x then row of y; may hold NaN.
        valid: [E,P] bool. width: of the grid; P is a multiple of it.
        ii, jj: [E] rows of the frames in a stack [K,P].
    """
    height = xy.shape[2] // width
    least = xy.new_zeros(2, 1)
    most = on_device([[width - 1.0], [height - 1.0]], xy.device, xy.dtype)
    place = xy.clamp(least, most)
    within = place == xy  # what the clamp changes is outside; NaN equals nothing
    inside = within[:, 0] & within[:, 1] & valid
    place.nan_to_num_()
    # The last row and column are reached with weight 1 from their left and upper neighbour.
    corner = place.floor().minimum((most - 1).clamp_min_(0))
    a, b = (place - corner).unbind(1)
    left, top = corner.unbind(1)
    first = torch.add(left, top, alpha=width).long().add_((jj * xy.shape[2])[:, None])
    weights = xy.new_empty(4, *a.shape)
    torch.mul(a, b, out=weights[3])
    torch.sub(b, weights[3], out=weights[2])
    torch.sub(a, weights[3], out=weights[1])
    torch.sub(1.0 - a, weights[2], out=weights[0])
    return Samples(
        ii, place, first.flatten(), neighbours(height, width), weights.flatten(1), inside
    )


def interpolate(table: Tensor, samples: Samples) -> Tensor:
    """Bilinear values [E,P] of a stack [K,P]."""
    flat = table.flatten()
    found = flat.index_select(0, samples.first).mul_(samples.weights[0])
    for step, weight in zip(samples.steps[1:], samples.weights[1:], strict=True):
        # The same index into a shifted view: the neighbour.
        found.addcmul_(flat[step:].index_select(0, samples.first), weight)
    return found.view(samples.inside.shape)


def scatter(values: Tensor, samples: Samples, frames: int) -> Tensor:
    """The adjoint of `interpolate`: spread values [E,P] onto a stack [K,P] of `frames` frames."""
    flat = values.flatten()
    out = values.new_zeros(frames * samples.inside.shape[1])
    for step, weight in zip(samples.steps, samples.weights, strict=True):
        out[step:].scatter_add_(0, samples.first, flat * weight)
    return out.view(frames, -1)


def similarity(features: Tensor, samples: Samples, lengths: Tensor | None = None) -> Tensor:
    """Cosine [E,P] between the feature of the cell and the interpolated one, in [-1,1].

    Args:
        features: [K,P,C], raw; the interpolated vector is normalised, not its neighbours.
        lengths: [K,P] of the features, if they are known.
    """
    n_edges, cells = samples.inside.shape
    channels = features.shape[2]
    table = features.reshape(-1, channels)
    if lengths is None:
        lengths = features.norm(dim=2)
    first = samples.first.to(torch.int32)
    steps = on_device(samples.steps, features.device, torch.int32)
    if features.is_cuda:
        index, weight = first[:, None] + steps, samples.weights.T.contiguous()
        cosine = features.new_empty(n_edges, cells)
        group = max(_TOGETHER // cells, 1)
        for start in range(0, n_edges, group):
            # One launch for all edges of a group, and the host need not know their sources.
            some = slice(start, start + group)
            rows = slice(start * cells, (start + group) * cells)
            met = F.embedding_bag(index[rows], table, mode="sum", per_sample_weights=weight[rows])
            met, source = met.view(-1, cells, channels), samples.source[some]
            product = (met * features.index_select(0, source)).sum(2)
            length = lengths.index_select(0, source) * torch.linalg.vector_norm(met, dim=2)
            torch.div(product, length.add_(EPSILON), out=cosine[some])
        return cosine
    ones = features.new_ones(channels)
    dot, square = features.new_empty(2, n_edges * cells).unbind()
    group = max(_CHUNK // (cells * channels), 1)
    sources = samples.source.tolist()
    weights = features.new_empty(min(group, n_edges) * cells, 4)
    product = features.new_empty(min(group, n_edges) * cells, channels)
    for start in range(0, n_edges, group):
        edges = sources[start : start + group]
        count = len(edges) * cells
        rows = slice(start * cells, start * cells + count)
        weights[:count].copy_(samples.weights[:, rows].T)
        # A weighted embedding bag is a bilinear gather that never stores the four neighbours.
        there: Tensor = F.embedding_bag(
            first[rows, None] + steps, table, mode="sum", per_sample_weights=weights[:count]
        )
        for k, source in enumerate(edges):
            part = slice(k * cells, (k + 1) * cells)
            torch.mul(there[part], features[source], out=product[part])
        # Sums over channels as products with ones, which are several times faster.
        torch.mv(product[:count], ones, out=dot[rows])
        torch.mv(there.mul_(there), ones, out=square[rows])
    length = lengths.index_select(0, samples.source).flatten() * square.sqrt_()
    return dot.div_(length.add_(EPSILON)).view(n_edges, cells)


def calibrated(cosine: Tensor, samples: Samples, bulk: float) -> Tensor:
    """Cosines [E,P] of which the middle one of each edge is at least `1 - bulk`.

    What lowers the similarity of a whole picture says nothing about what moves: an unusual
    appearance, poses not yet found, a wide baseline. So the dissimilarity `1 - cosine` of an edge
    is scaled down to `bulk` at its median over the cells that are inside. It holds while less
    than half of the picture moves.
    """
    # Every third cell tells the median well enough, at a third of the sorting.
    some = torch.where(samples.inside, 1.0 - cosine, math.nan)[:, ::3]
    middle = some.nanmedian(dim=1, keepdim=True).values
    scale = (bulk / middle.clamp_min(EPSILON)).clamp_max_(1.0).nan_to_num_(1.0)
    return 1.0 - (1.0 - cosine) * scale


def residual(
    cosine: Tensor, samples: Samples, threshold: float = 0.5, floor: float = 0.0
) -> Tensor:
    """`1 - s` with s the cosine clamped to [floor,1], and 0 unless it exceeds the threshold.

    Args:
        cosine: [E,P].
        threshold: a cosine up to here is no similarity; -1 lets all be.
        floor: cosines below count as this; -1 lets all be.
    Returns:
        [E,P]; 0 for pairs that are not inside, so that they take no part.
    """
    kept = cosine.clamp(floor, 1.0)
    if threshold > floor:
        kept.masked_fill_(kept <= threshold, 0.0)
    return (1.0 - kept).mul_(samples.inside)


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
    here = u.index_select(0, samples.source)
    if not decoupled:
        energy = rho / (here * here)
        return torch.zeros_like(u).index_add_(0, samples.source, -2 * energy / here), energy.sum()
    there = interpolate(u, samples)
    energy = (rho / here).div_(there)
    gradient = scatter((energy / there).neg_(), samples, u.shape[0])
    total = energy.sum()
    return gradient.index_add_(0, samples.source, energy.div_(here), alpha=-1), total


def frame_gradient(
    pair: Tensor, u: Tensor, counts: Tensor | None, gamma_data: float, gamma_prior: float
) -> Tensor:
    """J of REFERENCE 4.3: the pair gradient per edge of the frame, plus that of the prior.

    Because every frame has its own factor, this is not the gradient of one scalar energy.

    Args:
        pair, u: [K,h,w]. counts: [K] number of edges in which a frame takes part; None: not
            divided, as the paper writes it, and then it is the gradient of one energy.
    """
    if counts is None:
        return gamma_data * pair + gamma_prior / (u + 1.0)
    share = gamma_data / (counts.to(u.dtype) + EPSILON)
    return share[:, None, None] * pair + gamma_prior / (u + 1.0)


def softplus(y: Tensor, offset: float) -> Tensor:
    """`log(1 + offset + e^y)`: the published map from y to uncertainty (paper: offset 0)."""
    # log(1 + offset) + log(1 + e^(y - log(1 + offset))), which does not overflow
    shift = math.log1p(offset)
    return F.softplus(y - shift).add_(shift)


def softplus_slope(y: Tensor, offset: float) -> Tensor:
    """Derivative of `softplus`: `1 / (1 + (1 + offset) e^-y)`."""
    return torch.sigmoid(y - math.log1p(offset))
