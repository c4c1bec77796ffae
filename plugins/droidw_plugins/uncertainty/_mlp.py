"""The model behind `mlp`."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from droidw.errors import ConfigError
from droidw.interfaces.uncertainty import StoreField, UncertaintyReport, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty._consistency import Consistency
from droidw_plugins.uncertainty.mlp import MlpOptions

__all__ = ["Layers", "Mlp", "backward", "forward"]

_EPSILON = 1e-8


class Layers(NamedTuple):
    """Parameters of the network, as views into one vector, or their gradients.

    Attributes:
        first: [H,C]. bias: [H]. second: [H]. offset: [1].
    """

    first: Tensor
    bias: Tensor
    second: Tensor
    offset: Tensor

    @classmethod
    def of(cls, vector: Tensor, hidden: int) -> Layers:
        """Views of a vector of `hidden * (C + 2) + 1` numbers."""
        channels = (vector.numel() - 1) // hidden - 2
        sizes = [hidden * channels, hidden, hidden, 1]
        first, bias, second, offset = torch.split(vector, sizes)
        return cls(first.view(hidden, channels), bias, second, offset)


def forward(rows: Tensor, layers: Layers) -> tuple[Tensor, Tensor]:
    """y [N] of rows [N,C], and the hidden values [N,H] that `backward` needs."""
    hidden = torch.addmm(layers.bias, rows, layers.first.T).relu_()
    return (hidden @ layers.second).add_(layers.offset), hidden


def backward(weight: Tensor, rows: Tensor, hidden: Tensor, layers: Layers) -> Tensor:
    """Gradient of `sum(weight * y)` with respect to all parameters, as one vector.

    Args:
        weight: [N]. rows: [N,C]. hidden: [N,H] of `forward`.
    """
    through = torch.outer(weight, layers.second).mul_(hidden > 0)
    parts = (through.T @ rows, through.sum(0), weight @ hidden, weight.sum()[None])
    return torch.cat([part.flatten() for part in parts])


class Mlp:
    """One shallow network for the whole run, a step of Adam at each update.

    Args:
        options: see `MlpOptions`.
        context: device, and the seed of the random start.
    Attributes:
        fields: see `Consistency.fields`.
    """

    def __init__(self, options: MlpOptions, context: BuildContext) -> None:
        self._options = options
        self._device = context.device
        self._objective = Consistency(options, context.device, "mlp")
        self.fields: tuple[StoreField, ...] = self._objective.fields
        # Drawn on the CPU, so that a seed means the same on every device.
        self._generator = torch.Generator().manual_seed(context.seed)
        self._state: dict[str, Tensor] = {}

    @torch.no_grad()
    def append(self, view: UncertaintyView, index: int) -> None:
        """Write `view.uncertainty[index]` [h,w] from the features of the new keyframe."""
        self._objective.append(view, index)
        rows = self._objective.rows(view, index, index + 1)
        y, _ = forward(rows[0], self._layers(view))
        u = objective.softplus(y, self._options.softplus_offset)
        self._objective.maps.append(view, index, u.view(view.uncertainty.shape[1:]))

    @torch.no_grad()
    def update(self, view: UncertaintyView) -> UncertaintyReport:
        """One step of Adam on the edges of the view, then new maps of `view.frames`.

        Returns:
            The report of `Numbers.read`, and as a fact `weights_norm`, before the step.
        """
        layers, offset = self._layers(view), self._options.softplus_offset
        if view.frames.numel() == 0:
            return UncertaintyReport()
        gradient, numbers = self._objective.gradient(view)
        known = view.indices().frames
        first, last = min(known), max(known) + 1
        rows = self._objective.rows(view, first, last)
        if len(known) != last - first:
            rows = rows[view.frames - first]
        rows = rows.flatten(0, 1)
        y, hidden = forward(rows, layers)
        weight = gradient.flatten() * objective.softplus_slope(y, offset)
        step = backward(weight, rows, hidden, layers) * self._objective.share(gradient)
        before = self._state["weights"].norm()
        report, told = numbers.read(finite=torch.isfinite(step).all(), norm=before)
        # A step that is not finite would poison the whole run; the report's energy shows it.
        if told["finite"]:
            self._adam(step)
            y, _ = forward(rows, self._layers(view))
            u = objective.softplus(y, offset)
            self._objective.maps.write(view, u.view(-1, *view.uncertainty.shape[1:]))
        return UncertaintyReport(report.energy, {**report.facts, "weights_norm": told["norm"]})

    def _adam(self, gradient: Tensor) -> None:
        """Adam (Kingma and Ba 2015) with decoupled weight decay."""
        options, state = self._options, self._state
        steps = state["steps"].add_(1)
        mean, square = state["mean"], state["square"]
        mean.lerp_(gradient, 1.0 - options.momentum)
        square.lerp_(gradient * gradient, 1.0 - options.square_decay)
        number = int(steps)
        rate = options.lr / (1.0 - options.momentum**number)
        root = (square / (1.0 - options.square_decay**number)).sqrt_().add_(_EPSILON)
        state["weights"].mul_(1.0 - options.weight_decay).addcdiv_(mean, root, value=-rate)

    def state_dict(self) -> dict[str, Any]:
        """`weights`, and `mean`, `square` and `steps` of Adam; empty before the first keyframe.

        Where similarities are calibrated, also what `MatchScale.state_dict` gives.
        """
        own = {name: value.clone() for name, value in self._state.items()}
        return {**own, **(self._objective.scale.state_dict() if own else {})}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`."""
        self._objective.forget()
        self._objective.scale.load_state_dict(state)
        own = {name: value for name, value in state.items() if name != "matches"}
        self._state = {name: value.clone().to(self._device) for name, value in own.items()}

    def _layers(self, view: UncertaintyView) -> Layers:
        """Parameters, made at the first call: N(0, 1/C) and `init_scale` N(0, 1/H), biases 0."""
        options, channels = self._options, view.features.shape[1]
        size = options.hidden * (channels + 2) + 1
        if not self._state:
            weights = torch.zeros(size)
            layers = Layers.of(weights, options.hidden)
            draw = self._generator
            first = torch.randn(options.hidden, channels, generator=draw)
            layers.first.copy_(first / max(channels, 1) ** 0.5)
            second = torch.randn(options.hidden, generator=draw)
            layers.second.copy_(second * (options.init_scale / options.hidden**0.5))
            self._state = {
                "weights": weights.to(self._device),
                "mean": torch.zeros(size, device=self._device),
                "square": torch.zeros(size, device=self._device),
                "steps": torch.zeros((), dtype=torch.int64),
            }
        elif self._state["weights"].numel() != size:
            raise ConfigError(
                f"the saved state of 'mlp' holds {self._state['weights'].numel()} numbers, but "
                f"{channels} feature channels and {options.hidden} hidden units need {size}",
                "resume with the features and options that the run was started with",
            )
        return Layers.of(self._state["weights"], options.hidden)
