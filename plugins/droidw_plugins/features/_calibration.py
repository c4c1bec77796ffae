"""Brings the cosine of raw network features to a range in which fixed thresholds make sense.

The outputs of a network share a large common direction, and a few channels dominate, so that two
unrelated cells have a cosine of 0.3 to 0.6. Subtracting the mean and whitening removes both; a
constant channel then sets the zero point: with unit vectors a, b and a constant k the cosine
becomes (a.b + k^2) / (1 + k^2), an increasing affine map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw_plugins.features._efficientnet import ChannelStatistics

__all__ = ["Calibration", "from_picture", "from_weights", "of_nothing"]


@dataclass(frozen=True)
class Calibration:
    """The map x -> normalise([matrix (x - mean), constant]) * length.

    Attributes:
        matrix: [D,C]. mean: [C].
        constant, length: see `CnnOptions`.
    """

    matrix: Tensor
    mean: Tensor
    constant: float
    length: float

    def __call__(self, features: Tensor) -> Tensor:
        """Calibrated features [D(+1),h,w] of raw ones [C,h,w]."""
        channels, height, width = features.shape
        found = self.matrix @ (features.reshape(channels, -1) - self.mean[:, None])
        if self.constant > 0:
            found = torch.cat([found, found.new_full((1, found.shape[1]), self.constant)])
        found = F.normalize(found, dim=0) * self.length
        return found.view(-1, height, width)

    def state_dict(self) -> dict[str, Any]:
        """What depends on the picture: `matrix` and `mean`."""
        return {"matrix": self.matrix, "mean": self.mean}


def of_nothing(like: Tensor, constant: float, length: float) -> Tensor:
    """Features [D,h,w] of a picture that shows nothing, in the space of `like` [D,h,w].

    They are those of a cell that is the mean of all, but for the constant channel, if there is one:
    whatever follows is as near to them as to anything else.
    """
    found = torch.zeros_like(like)
    if constant > 0:
        found[-1] = length
    return found


def from_weights(
    statistics: Sequence[ChannelStatistics],
    shares: Sequence[float],
    whiten: bool,
    constant: float,
    length: float,
    dim: int | None = None,
) -> Calibration:
    """Mean and per-channel deviation as batch normalisation holds them (no picture needed).

    Args:
        statistics: of every tap. shares: relative weight of every tap.
        whiten: False keeps the raw features (mean 0, deviation 1).
        dim: number of output rows; missing ones stay zero, surplus channels are dropped.
    """
    total = sum(share**2 for share in shares) ** 0.5
    rows = []
    for s, share in zip(statistics, shares, strict=True):
        scale = share / total / len(s.std) ** 0.5
        rows.append(scale / s.std if whiten else torch.ones_like(s.std) * scale)
    matrix = torch.diag(torch.cat(rows))
    if dim is not None and dim < matrix.shape[0]:
        matrix = matrix[:dim]
    mean = torch.cat([s.mean for s in statistics])
    return Calibration(matrix, mean if whiten else torch.zeros_like(mean), constant, length)


def from_picture(
    taps: Sequence[Tensor],
    statistics: Sequence[ChannelStatistics],
    shares: Sequence[float],
    shrinkage: float,
    dim: int | None,
    constant: float,
    length: float,
) -> Calibration:
    """Whitening by the covariance of one picture, shrunk towards that of the weights.

    Every tap is whitened by itself and gets its share of the squared length. Of the result the
    `dim` strongest directions in this picture are kept and scaled back to the same mean length.

    Args:
        taps: [C_t,h,w] per tap. statistics, shares: per tap.
        shrinkage: factor on the variances of the weights that are added, > 0.
        dim: rows of the result, or None for all.
    """
    total = sum(share**2 for share in shares) ** 0.5
    blocks, means = [], []
    for tap, s, share in zip(taps, statistics, shares, strict=True):
        # In float64 and on the CPU: the same bytes on every run, and no device solver needed.
        x = tap.flatten(1).double().cpu()
        covariance = torch.cov(x) + shrinkage * torch.diag(s.std.double().cpu() ** 2)
        values, vectors = torch.linalg.eigh(covariance)
        whitening = (vectors / values.sqrt()) @ vectors.T
        blocks.append(whitening * (share / total / x.shape[0] ** 0.5))
        means.append(x.mean(1))
    matrix, mean = _block_diagonal(blocks), torch.cat(means)
    if dim is not None and dim < matrix.shape[0]:
        x = torch.cat([tap.flatten(1) for tap in taps]).double().cpu() - mean[:, None]
        white = matrix @ x
        _, vectors = torch.linalg.eigh(white @ white.T)
        # The sign of an eigenvector is arbitrary; fix it, so that machines agree.
        top = vectors[:, -dim:].flip(1)
        signs = torch.sign(top.gather(0, top.abs().argmax(0, keepdim=True)))
        kept = (top * signs).T @ matrix
        ratio = white.square().sum() / (kept @ x).square().sum().clamp_min(1e-12)
        matrix = kept * ratio.sqrt()
    like = taps[0]
    return Calibration(
        matrix.to(like.device, like.dtype), mean.to(like.device, like.dtype), constant, length
    )


def _block_diagonal(blocks: Sequence[Tensor]) -> Tensor:
    size = sum(block.shape[0] for block in blocks)
    matrix = blocks[0].new_zeros(size, size)
    start = 0
    for block in blocks:
        end = start + block.shape[0]
        matrix[start:end, start:end] = block
        start = end
    return matrix
