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


@dataclass
class _Pairs:
    """Samples and residuals of one set of edges, kept for `refresh` steps."""

    ii: Tensor
    jj: Tensor
    frames: Tensor
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
    """

    fields: tuple[StoreField, ...] = ()

    def __init__(self, options: AffineSoftplusOptions, context: BuildContext) -> None:
        if options.u_min >= options.u_max:
            raise ConfigError(
                f"uncertainty.options.u_min: {options.u_min:g} is not below "
                f"uncertainty.options.u_max = {options.u_max:g}"
            )
        self._options = options
        self._device = context.device
        # Drawn on the CPU, so that a seed means the same on every device.
        self._generator = torch.Generator().manual_seed(context.seed)
        self._theta: Tensor | None = None
        self._pairs: _Pairs | None = None

    def append(self, view: UncertaintyView, index: int) -> None:
        """Write `view.uncertainty[index]` [h,w] from the features of the new keyframe."""
        self._pairs = None  # `index` may have meant another keyframe until now
        theta = self._parameters(view.features.shape[1])
        view.uncertainty[index] = self._map(view.features[index : index + 1], theta)[0]

    def update(self, view: UncertaintyView) -> UncertaintyReport:
        """One step of gradient descent on the edges of the view (REFERENCE 4.3).

        Returns:
            The mean pair energy before the step, and as facts: `pairs`, `similar` (share of pairs
            above the threshold) and `theta_norm`.
        """
        options = self._options
        theta = self._parameters(view.features.shape[1])
        height, width = view.uncertainty.shape[1:]
        pairs = self._pairs_of(view)
        u = view.uncertainty[pairs.frames]
        pair, energy = objective.pair_gradient(
            u.flatten(), pairs.rho, pairs.samples, options.decoupled
        )
        gradient = objective.frame_gradient(
            pair.view(-1, height, width), u, pairs.counts, options.gamma_data, options.gamma_prior
        )
        learned = torch.isin(pairs.frames, view.frames)
        frames = pairs.frames[learned]
        if options.affine:
            features = view.features[frames].flatten(2).float()
            y = self._linear(features, theta)
            weight = gradient[learned].flatten(1) * objective.softplus_slope(
                y, options.softplus_offset
            )
            # Mean over cells, then over frames; one matrix-vector product per frame.
            slope = torch.einsum("kcp,kp->c", features, weight) / max(weight.numel(), 1)
            bias = weight.sum() / max(weight.numel(), 1)
            step = torch.cat([slope, bias[None] if options.bias else torch.zeros_like(bias)[None]])
            theta = theta - options.lr * step - options.weight_decay * theta
            # A step that is not finite would poison the whole run; the report shows it.
            if bool(torch.isfinite(theta).all()):
                self._theta = theta
                y = self._linear(features, theta).view(-1, height, width)
                view.uncertainty[frames] = objective.softplus(y, options.softplus_offset)
        else:
            moved = u[learned] - options.lr * gradient[learned]
            view.uncertainty[frames] = moved.clamp(options.u_min, options.u_max)
        count = pairs.rho.numel()
        return UncertaintyReport(
            energy=float(energy) / max(count, 1),
            facts={
                "pairs": float(count),
                "similar": float((pairs.rho < 1).float().mean()) if count else 0.0,
                "theta_norm": float(theta.norm()),
            },
        )

    def state_dict(self) -> dict[str, Any]:
        """`theta` [C+1] (weights, then bias), or an empty dict before the first keyframe."""
        return {} if self._theta is None else {"theta": self._theta.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`."""
        self._pairs = None
        self._theta = state["theta"].clone().to(self._device) if state else None

    def _parameters(self, channels: int) -> Tensor:
        """theta, made at the first call: weights from N(0, 1/C), bias 0."""
        if channels == 0:
            raise ConfigError(
                "uncertainty.name: 'affine-softplus' needs features, but the feature extractor "
                "gives none",
                "choose an extractor, e.g. features=cnn, or switch both off: uncertainty=none",
            )
        if self._theta is None:
            weights = torch.randn(channels, generator=self._generator) / channels**0.5
            self._theta = torch.cat([weights, torch.zeros(1)]).to(self._device)
        elif self._theta.numel() != channels + 1:
            raise ConfigError(
                f"the saved state of 'affine-softplus' is for {self._theta.numel() - 1} feature "
                f"channels, but the extractor gives {channels}",
                "resume with the features that the run was started with",
            )
        return self._theta

    def _linear(self, features: Tensor, theta: Tensor) -> Tensor:
        """y [K,h*w] of features [K,C,h*w]."""
        return torch.einsum("kcp,c->kp", features, theta[:-1]) + theta[-1]

    def _map(self, features: Tensor, theta: Tensor) -> Tensor:
        y = self._linear(features.flatten(2).float(), theta)
        if not self._options.affine:
            y = torch.zeros_like(y)  # every cell starts at u(0), as theta starts around 0
        u = objective.softplus(y, self._options.softplus_offset)
        return u.view(-1, *features.shape[-2:])

    def _pairs_of(self, view: UncertaintyView) -> _Pairs:
        kept = self._pairs
        if (
            kept is not None
            and kept.age + 1 < self._options.refresh
            and torch.equal(kept.ii, view.ii)
            and torch.equal(kept.jj, view.jj)
            and bool(torch.isin(view.frames, kept.frames).all())
        ):
            kept.age += 1
            return kept
        used = objective.edges_used(view.ii, view.jj, self._options.min_gap)
        ii, jj = view.ii[used], view.jj[used]
        frames, place = torch.unique(torch.cat([ii, jj, view.frames]), return_inverse=True)
        a, b = place[: len(ii)], place[len(ii) : 2 * len(ii)]
        counts = torch.bincount(torch.cat([a, b]), minlength=len(frames))
        coords, valid = reproject(view.T_cw, view.disps, view.intrinsics, ii, jj)
        samples = objective.make_samples(coords, valid, a, b)
        channels = view.features.shape[1]
        rows = view.features[frames].flatten(2).transpose(1, 2).reshape(-1, channels).float()
        cosine = objective.similarity(rows, samples)
        rho = objective.residual(cosine, self._options.similarity_threshold)
        self._pairs = _Pairs(view.ii.clone(), view.jj.clone(), frames, counts, samples, rho)
        return self._pairs
