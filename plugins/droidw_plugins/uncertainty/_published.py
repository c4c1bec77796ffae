"""From what was learned to the map that is written: smoothing, and the evidence of residuals."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.geometry.transfer import on_device
from droidw.interfaces.uncertainty import StoreField, UncertaintyView
from droidw.solve.weights import agreeing_share
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty._options import ObjectiveOptions

__all__ = ["Publisher", "agreeing_majority", "box_mean", "residual_factor"]

_LEARNED = "uncertainty_learned"
_FACTOR = "uncertainty_factor"
_NEUTRAL = 1.0 / 3.0
"""Agreement at which the factor is one; that of a cell of which nothing was measured."""
_PRIOR = 0.1
"""Confidence with which every cell starts out as neutral."""
_FAR = 4.0
"""Residuals beyond so many cells count as this."""
_RAMP = 0.2
"""How far above the least share of agreeing motion residuals count in full."""


def box_mean(maps: Tensor, radius: int) -> Tensor:
    """Means [N,h,w] over squares of `2 radius + 1` cells, of fewer at the border."""
    if radius == 0:
        return maps
    size = 2 * radius + 1
    return F.avg_pool2d(maps, size, 1, radius, count_include_pad=False)


def residual_factor(
    residual: Tensor, confidence: Tensor, ii: Tensor, frames: int, scale: float,
    gain: float | Tensor, smooth: int, each: bool = False,
) -> Tensor:  # fmt: skip
    """Factor [N,h,w] on the uncertainty of each cell: below one where measured motion agrees.

    With r the mean residual of a cell over its edges, weighted by confidence, the agreement is
    `A = 1 / (1 + (r / scale)^2)` and the factor `1 + gain (1/3 - A)`.

    Args:
        residual: [E,h,w] distance of measured and predicted place, cells; 0 confidence where it
            means nothing. confidence: [E,h,w]. ii: [E] in [0, frames).
        smooth: radius over which r is averaged.
        each: A is the mean of the agreements of the edges instead, of the cell alone. A few that
            were measured badly do not outweigh those that agree, nor does what moves beside it.
    """
    weight, cut = _usable(residual, confidence)
    shape = (frames, *residual.shape[1:])
    total = weight.new_full(shape, _PRIOR).index_add_(0, ii, weight)
    if each:
        agrees = weight / (1.0 + (cut / scale).square_())
        start = weight.new_full(shape, _PRIOR * _NEUTRAL)
        return 1.0 + gain * (_NEUTRAL - start.index_add_(0, ii, agrees).div_(total))
    # At this residual the agreement is neutral.
    start = weight.new_full(shape, _PRIOR * scale * (1.0 / _NEUTRAL - 1.0) ** 0.5)
    mean = start.index_add_(0, ii, weight * cut).div_(total)
    agreement = 1.0 / (1.0 + (box_mean(mean, smooth) / scale).square_())
    return 1.0 + gain * (_NEUTRAL - agreement)


def agreeing_majority(
    residual: Tensor, confidence: Tensor, scale: float, least: float
) -> float | Tensor:
    """How far residuals may be believed, in [0,1]: by the share that agrees with the poses.

    Where tracking has been lost, or follows what moves, most measured motion disagrees, and what
    agrees is the wrong part. With a the share that agrees (`droidw.solve.weights.agreeing_share`),
    the result is 0 up to a = `least` and 1 from 0.2 more.

    Args:
        residual, confidence: [E,h,w], as for `residual_factor`.
        least: share in [0,1); 0 believes always.
    """
    if least == 0:
        return 1.0
    weight, cut = _usable(residual, confidence)
    return ((agreeing_share(cut, weight, scale) - least) / _RAMP).clamp(0.0, 1.0)


def _usable(residual: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
    """Confidences with 0 where nothing is known, and bounded residuals; both [E,h,w]."""
    weight = torch.where(torch.isfinite(residual) & torch.isfinite(confidence), confidence, 0.0)
    return weight, residual.nan_to_num(_FAR, _FAR, _FAR).clamp_max(_FAR)


class Publisher:
    """Writes maps to the store; what was learned stays apart where the two differ.

    Args:
        options: `smooth`, `learn_majority`, `mended_gain` and those named `residual_...` are read.
    Attributes:
        fields: none by default; else the map [h,w] as learned, and the factor of `residual_factor`
            as it was last found.
        begun: whether the maps began with something that is worth keeping.
        believed: how far tracking may be learned from, in [0,1], with `learn_majority` and if
            `begun`.
    """

    def __init__(self, options: ObjectiveOptions) -> None:
        self._options = options
        self._apart = max(options.smooth, options.residual_gain, options.mended_gain) > 0
        fields = []
        if self._apart:
            fields = [StoreField(_LEARNED, ("h", "w")), StoreField(_FACTOR, ("h", "w"), fill=1.0)]
        self.fields: tuple[StoreField, ...] = tuple(fields)
        self.begun = False
        self.believed: float | Tensor = 1.0

    def learned(self, view: UncertaintyView) -> Tensor:
        """The maps [N,h,w] that the objective is about."""
        return view.fields[_LEARNED] if self._apart else view.uncertainty

    def append(self, view: UncertaintyView, index: int, u: Tensor) -> None:
        """Write the map [h,w] of a new keyframe, of which no motion was measured yet."""
        if self._apart:
            view.fields[_LEARNED][index] = u
            view.fields[_FACTOR][index] = 1.0
            u = box_mean(u[None], self._options.smooth)[0]
        view.uncertainty[index] = u

    def weigh(self, view: UncertaintyView) -> None:
        """Renew the factors of the frames that edges of the view start from."""
        options = self._options
        least = options.learn_majority if self.begun else 0.0
        mended = view.mended and options.mended_gain > 0
        gain = options.mended_gain if mended else options.residual_gain
        if max(gain, least) == 0 or view.ii.numel() == 0:
            return
        known = view.indices().ii
        first, last = min(known), max(known) + 1
        xy, valid = objective.project(view.T_cw, view.disps, view.intrinsics, view.ii, view.jj)
        shape = view.target.shape[:3]
        apart = view.target.movedim(-1, 1) - xy.view(shape[0], 2, *shape[1:])
        residual = torch.linalg.vector_norm(apart, dim=1)
        confidence = view.confidence[..., :2].mean(-1) * valid.view(shape)
        counts = confidence
        if (mended or least > 0) and view.gate is not None:
            counts = confidence * view.gate(view.uncertainty)[view.ii]
        scale, majority = options.residual_scale, options.residual_majority
        if least > 0:
            self.believed = agreeing_majority(residual, counts, scale, least)
        if gain == 0:
            return
        if mended:
            # What is closed need not agree. And less of the rest has to than while tracking: where
            # matches are poor, two thirds of it are all that agrees with a right path.
            believed = agreeing_majority(residual, counts, scale, max(majority - _RAMP, 0.0))
        else:
            believed = agreeing_majority(residual, confidence, scale, majority)
        factor = residual_factor(
            residual,
            confidence,
            view.ii - first,
            last - first,
            scale,
            gain * believed,
            options.smooth,
            each=mended,
        )
        starts = on_device(sorted(set(known)), view.disps.device)
        view.fields[_FACTOR][starts] = factor[starts - first]

    def write(self, view: UncertaintyView, u: Tensor) -> None:
        """Write the maps [F,h,w] of `view.frames`."""
        if self._apart:
            view.fields[_LEARNED][view.frames] = u
            u = box_mean(u, self._options.smooth) * view.fields[_FACTOR][view.frames]
        view.uncertainty[view.frames] = u
