"""The model behind `affine-softplus`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from droidw.errors import ConfigError
from droidw.geometry.projective import reproject
from droidw.interfaces.uncertainty import StoreField, UncertaintyReport, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty.affine_softplus import AffineSoftplusOptions

__all__ = ["AffineSoftplus"]


_ROWS = "affine_softplus_rows"


@dataclass
class _Pairs:
    """Samples and residuals of one set of edges, kept for `refresh` steps.

    `first` and `last` bound the keyframes that take part; rows count from `first`.
    """

    ii: Tensor
    jj: Tensor
    first: int
    last: int
    counts: Tensor
    samples: objective.Samples
    rho: Tensor
    age: int = 0


class AffineSoftplus:
    """One vector theta for the whole run: `y = theta . [f, 1]`, `u = log(1 + offset + e^y)`.

    Each step changes theta by gradient descent on the consistency of the given edges, then renews
    the maps of `view.frames`. With `affine=False` the maps themselves are the parameters.

    Args:
        options: see `AffineSoftplusOptions`.
        context: device, and the seed of the random start of theta.
    Attributes:
        fields: the features with the channels last, [h,w,c], on a CPU.
    """

    def __init__(self, options: AffineSoftplusOptions, context: BuildContext) -> None:
        if options.u_min >= options.u_max:
            raise ConfigError(
                f"uncertainty.options.u_min: {options.u_min:g} is not below "
                f"uncertainty.options.u_max = {options.u_max:g}"
            )
        self._options = options
        self._device = context.device
        # On a CPU the features are kept a second time with the channels last: bringing a window
        # into that order at every step would cost more than the step. A GPU does not notice.
        self.fields: tuple[StoreField, ...] = ()
        if context.device.type == "cpu":
            self.fields = (StoreField(_ROWS, ("h", "w", "c")),)
        # Drawn on the CPU, so that a seed means the same on every device.
        self._generator = torch.Generator().manual_seed(context.seed)
        self._theta: Tensor | None = None
        self._pairs: _Pairs | None = None

    @torch.no_grad()
    def append(self, view: UncertaintyView, index: int) -> None:
        """Write `view.uncertainty[index]` [h,w] from the features of the new keyframe."""
        self._pairs = None  # `index` may have meant another keyframe until now
        theta = self._parameters(view.features.shape[1])
        if self.fields:
            view.fields[_ROWS][index] = view.features[index].movedim(0, -1)
        rows = self._rows(view, index, index + 1)
        shape = view.uncertainty.shape[1:]
        y = self._linear(rows, theta)
        if not self._options.affine:
            y = torch.zeros_like(y)  # where theta starts, on average
        view.uncertainty[index] = objective.softplus(y, self._options.softplus_offset).view(shape)

    @torch.no_grad()
    def update(self, view: UncertaintyView) -> UncertaintyReport:
        """One step of gradient descent on the edges of the view (REFERENCE 4.3).

        Returns:
            The mean pair energy before the step, and as facts: `pairs`, `similar` (share of pairs
            above the threshold) and `theta_norm`.
        """
        options = self._options
        theta = self._parameters(view.features.shape[1])
        if view.frames.numel() == 0:
            return UncertaintyReport()
        pairs = self._pairs_of(view)
        u = view.uncertainty[pairs.first : pairs.last]
        pair, energy = objective.pair_gradient(
            u.flatten(1), pairs.rho, pairs.samples, options.decoupled
        )
        gradient = objective.frame_gradient(
            pair.view(u.shape), u, pairs.counts, options.gamma_data, options.gamma_prior
        )[view.frames - pairs.first]
        if options.affine:
            theta = self._descend(view, gradient.flatten(1), theta)
        else:
            moved = view.uncertainty[view.frames] - options.lr * gradient
            view.uncertainty[view.frames] = moved.clamp(options.u_min, options.u_max)
        count = int(pairs.samples.inside.sum())
        return UncertaintyReport(
            energy=float(energy) / max(count, 1),
            facts={
                "pairs": float(count),
                "similar": 1.0 - int((pairs.rho == 1).sum()) / max(count, 1),
                "theta_norm": float(theta.norm()),
            },
        )

    def _descend(self, view: UncertaintyView, gradient: Tensor, theta: Tensor) -> Tensor:
        """Move theta along the gradient [F,P] with respect to u, and renew the maps."""
        options = self._options
        # Views into the store from the first to the last of the frames: nothing is copied.
        first, last = int(view.frames.min()), int(view.frames.max()) + 1
        rows = self._rows(view, first, last)
        y = self._linear(rows, theta)
        place = view.frames - first
        weight = torch.zeros_like(y)
        weight[place] = gradient * objective.softplus_slope(y[place], options.softplus_offset)
        # Mean over cells, then over frames, as one matrix-vector product.
        slope = weight.flatten() @ rows.flatten(0, 1) / gradient.numel()
        bias = weight.sum() / gradient.numel() if options.bias else weight.new_zeros(())
        step = torch.cat([slope, bias[None]])
        theta = theta - options.lr * step - options.weight_decay * theta
        # A step that is not finite would poison the whole run; the report's energy shows it.
        if bool(torch.isfinite(theta).all()):
            self._theta = theta
            y = self._linear(rows, theta)[place]
            u = objective.softplus(y, options.softplus_offset)
            view.uncertainty[view.frames] = u.view(-1, *view.uncertainty.shape[1:])
        return theta

    def state_dict(self) -> dict[str, Any]:
        """`theta` [C+1] (weights, then bias), or an empty dict before the first keyframe."""
        return {} if self._theta is None else {"theta": self._theta.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`."""
        self._pairs = None
        self._theta = state["theta"].clone().to(self._device) if state else None

    def _parameters(self, channels: int) -> Tensor:
        """theta, made at the first call: weights from N(0, 1/C) times `init_scale`, bias 0."""
        if channels == 0:
            raise ConfigError(
                "uncertainty.name: 'affine-softplus' needs features, but the feature extractor "
                "gives none",
                "choose an extractor, e.g. features=cnn, or switch both off: uncertainty=none",
            )
        if self._theta is None:
            weights = torch.randn(channels, generator=self._generator)
            weights *= self._options.init_scale / channels**0.5
            self._theta = torch.cat([weights, torch.zeros(1)]).to(self._device)
        elif self._theta.numel() != channels + 1:
            raise ConfigError(
                f"the saved state of 'affine-softplus' is for {self._theta.numel() - 1} feature "
                f"channels, but the extractor gives {channels}",
                "resume with the features that the run was started with",
            )
        return self._theta

    def _rows(self, view: UncertaintyView, first: int, last: int) -> Tensor:
        """Features of a range of keyframes as float32 rows [n,P,C]."""
        if self.fields:
            return view.fields[_ROWS][first:last].flatten(1, 2)
        return view.features[first:last].flatten(2).transpose(1, 2).float()

    @staticmethod
    def _linear(rows: Tensor, theta: Tensor) -> Tensor:
        """y [n,P] of rows [n,P,C]."""
        return rows @ theta[:-1] + theta[-1]

    def _pairs_of(self, view: UncertaintyView) -> _Pairs:
        kept = self._pairs
        if (
            kept is not None
            and kept.age + 1 < self._options.refresh
            and torch.equal(kept.ii, view.ii)
            and torch.equal(kept.jj, view.jj)
            and kept.first <= int(view.frames.min())
            and kept.last > int(view.frames.max())
        ):
            kept.age += 1
            return kept
        used = objective.edges_used(view.ii, view.jj, self._options.min_gap)
        ii, jj = view.ii[used], view.jj[used]
        touched = torch.cat([ii, jj, view.frames])
        first, last = int(touched.min()), int(touched.max()) + 1
        counts = torch.bincount(torch.cat([ii, jj]) - first, minlength=last - first)
        coords, valid = reproject(view.T_cw, view.disps, view.intrinsics, ii, jj)
        samples = objective.make_samples(coords, valid, ii - first, jj - first)
        cosine = objective.similarity(self._rows(view, first, last), samples)
        rho = objective.residual(cosine, samples, self._options.similarity_threshold)
        self._pairs = _Pairs(view.ii.clone(), view.jj.clone(), first, last, counts, samples, rho)
        return self._pairs
