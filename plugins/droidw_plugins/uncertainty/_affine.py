"""The model behind `affine-softplus`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from droidw.errors import ConfigError
from droidw.interfaces.uncertainty import StoreField, UncertaintyReport, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty._consistency import Consistency, Numbers
from droidw_plugins.uncertainty._regression import Regression
from droidw_plugins.uncertainty.affine_softplus import AffineSoftplusOptions

__all__ = ["AffineSoftplus", "affine", "affine_gradient"]


def affine(rows: Tensor, theta: Tensor) -> Tensor:
    """y [n,P] of rows [n,P,C] and theta [C+1], weights and then the bias."""
    return (rows @ theta[:-1]).add_(theta[-1])


def affine_gradient(weight: Tensor, rows: Tensor, bias: bool = True) -> Tensor:
    """Gradient [C+1] with respect to theta of `sum(weight * y)`, as one matrix-vector product.

    Args:
        weight: [n,P]. rows: [n,P,C]. bias: false: the last entry is 0.
    """
    slope = weight.flatten() @ rows.flatten(0, 1)
    return torch.cat([slope, (weight.sum() if bias else weight.new_zeros(()))[None]])


@dataclass(frozen=True)
class _Mapped:
    """y [n,P] of the keyframes from `first` to `last`, with these parameters."""

    theta: Tensor
    first: int
    last: int
    y: Tensor


class AffineSoftplus:
    """One vector theta for the whole run: `y = theta . [f, 1]`, `u = log(1 + offset + e^y)`.

    Each step changes theta by gradient descent on the consistency of the given edges, then renews
    the maps of `view.frames`.

    Args:
        options: see `AffineSoftplusOptions`.
        context: device, and the seed of the random start of theta.
    Attributes:
        fields: see `Consistency.fields`. begins, renews: whether `begin` and `renew` are wanted.
    """

    def __init__(self, options: AffineSoftplusOptions, context: BuildContext) -> None:
        self._options = options
        self._device = context.device
        self._objective = Consistency(options, context.device, "affine-softplus")
        self.fields: tuple[StoreField, ...] = self._objective.fields
        # Drawn on the CPU, so that a seed means the same on every device.
        self._generator = torch.Generator().manual_seed(context.seed)
        self._theta: Tensor | None = None
        self._home: Tensor | float = 0.0
        self._seen: Regression | None = None
        self._mapped: _Mapped | None = None
        self.begins = options.movable_gain > 0
        self.renews = self.begins and options.movable_keep > 0

    @torch.no_grad()
    def begin(self, view: UncertaintyView, movable: Tensor) -> None:
        """Start theta at what comes closest to `movable` [N,h,w], and from now on decay to that.

        What a classifier says spreads over what surrounds a thing. The surroundings are seen
        without the thing, too, so that the fit is sharper than what it is fitted to.
        """
        known = view.indices().frames
        first, last = min(known), max(known) + 1
        rows = self._objective.rows(view, first, last)
        options = self._options
        self._seen = Regression.of(rows, movable[first:last].flatten(1))
        self._theta = self._home = theta = self._fitted(self._seen)
        self._objective.maps.begun = True
        self._mapped = None
        u = objective.softplus(affine(rows, theta), options.softplus_offset)
        u = u[view.frames - first].view(-1, *view.uncertainty.shape[1:])
        self._objective.maps.write(view, u)

    @torch.no_grad()
    def renew(self, view: UncertaintyView, index: int, movable: Tensor) -> None:
        """Let a later keyframe, with what can move in it [h,w], take part in what theta decays to.

        What was learned since the start is kept: theta moves along.
        """
        if self._seen is None or self._theta is None:
            return
        rows = view.features[index].flatten(1).T[None].float()
        later = Regression.of(rows, movable.flatten()[None])
        self._seen = self._seen.and_then(later, self._options.movable_keep)
        home = self._fitted(self._seen)
        self._theta, self._home = self._theta + (home - self._home), home
        self._mapped = None

    def _fitted(self, seen: Regression) -> Tensor:
        """theta [C+1] of what can move, by all that was seen."""
        options = self._options
        theta = options.movable_gain * seen.theta()
        theta[-1] -= options.movable_gain * options.movable_at
        return theta

    @torch.no_grad()
    def append(self, view: UncertaintyView, index: int) -> None:
        """Write `view.uncertainty[index]` [h,w] from the features of the new keyframe."""
        self._objective.append(view, index)
        self._mapped = None
        y = affine(self._objective.rows(view, index, index + 1), self._parameters(view))
        u = objective.softplus(y, self._options.softplus_offset)
        self._objective.maps.append(view, index, u.view(view.uncertainty.shape[1:]))

    @torch.no_grad()
    def update(self, view: UncertaintyView) -> UncertaintyReport:
        """One step of gradient descent on the edges of the view (REFERENCE 4.3).

        Returns:
            The report of `Numbers.read`, and as a fact `theta_norm`.
        """
        theta = self._parameters(view)
        if view.frames.numel() == 0:
            return UncertaintyReport()
        gradient, numbers = self._objective.gradient(view)
        return self._descend(view, gradient.flatten(1), theta, numbers)

    def _descend(
        self, view: UncertaintyView, gradient: Tensor, theta: Tensor, numbers: Numbers
    ) -> UncertaintyReport:
        """Move theta along the gradient [F,P] with respect to u, and renew the maps."""
        options, frames, known = self._options, view.frames, view.indices().frames
        # Views into the store from the first to the last of the frames: nothing is copied.
        first, last = min(known), max(known) + 1
        rows = self._objective.rows(view, first, last)
        last_map = self._mapped
        if (
            last_map
            and last_map.theta is theta
            and (last_map.first, last_map.last) == (first, last)
        ):
            y = last_map.y
        else:
            y = affine(rows, theta)
        place = frames - first
        weight = torch.zeros_like(y)
        weight[place] = gradient * objective.softplus_slope(y[place], options.softplus_offset)
        step = affine_gradient(weight, rows, options.bias).mul_(self._objective.share(gradient))
        theta = theta - options.lr * step - options.weight_decay * (theta - self._home)
        report, told = numbers.read(finite=torch.isfinite(theta).all(), norm=theta.norm())
        # A step that is not finite would poison the whole run; the report's energy shows it.
        if told["finite"]:
            self._theta = theta
            y = affine(rows, theta)
            self._mapped = _Mapped(theta, first, last, y)
            u = objective.softplus(y[place], options.softplus_offset)
            self._objective.maps.write(view, u.view(-1, *view.uncertainty.shape[1:]))
        return UncertaintyReport(report.energy, {**report.facts, "theta_norm": told["norm"]})

    def state_dict(self) -> dict[str, Any]:
        """`theta` [C+1] (weights, then bias), or an empty dict before the first keyframe.

        With `movable_gain` also `home` [C+1], what it decays to, and the sums it was fitted to.
        Where similarities are calibrated, also what `MatchScale.state_dict` gives.
        """
        state = self._objective.scale.state_dict()
        if isinstance(self._home, Tensor):
            state["home"] = self._home.clone()
        if self._seen is not None:
            state["seen"] = self._seen.state_dict()
        return {} if self._theta is None else {"theta": self._theta.clone(), **state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`."""
        self._objective.forget()
        self._objective.scale.load_state_dict(state)
        self._mapped = None
        self._theta = state["theta"].clone().to(self._device) if state else None
        self._home = state["home"].clone().to(self._device) if "home" in state else 0.0
        seen = state.get("seen")
        self._seen = seen and Regression(**{k: v.clone().to(self._device) for k, v in seen.items()})
        self._objective.maps.begun = "home" in state

    def _parameters(self, view: UncertaintyView) -> Tensor:
        """theta, made at the first call: weights from N(0, 1/C) times `init_scale`, bias 0."""
        channels = view.features.shape[1]
        if self._theta is None:
            weights = torch.randn(channels, generator=self._generator)
            weights *= self._options.init_scale / max(channels, 1) ** 0.5
            self._theta = torch.cat([weights, torch.zeros(1)]).to(self._device)
        elif self._theta.numel() != channels + 1:
            raise ConfigError(
                f"the saved state of 'affine-softplus' is for {self._theta.numel() - 1} feature "
                f"channels, but the extractor gives {channels}",
                "resume with the features that the run was started with",
            )
        return self._theta
