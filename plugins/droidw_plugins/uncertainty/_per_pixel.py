"""The model behind `per-pixel`."""

from __future__ import annotations

from typing import Any

import torch

from droidw.errors import ConfigError
from droidw.interfaces.uncertainty import StoreField, UncertaintyReport, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw_plugins.uncertainty._consistency import Consistency
from droidw_plugins.uncertainty.per_pixel import PerPixelOptions

__all__ = ["PerPixel"]


class PerPixel:
    """The maps themselves are the parameters: `u <- clamp(u - lr J)` (REFERENCE 4.3).

    They live in the store and so move and die with their keyframe; the model has no state of its
    own but the scale of similarities.

    Args:
        options: see `PerPixelOptions`.
        context: device.
    Attributes:
        fields: see `Consistency.fields`.
    Raises:
        ConfigError: the range of u is empty, or the start lies outside.
    """

    def __init__(self, options: PerPixelOptions, context: BuildContext) -> None:
        if not options.u_min <= options.start <= options.u_max or options.u_min == options.u_max:
            raise ConfigError(
                f"uncertainty.options.u_min, start, u_max: {options.u_min:g}, {options.start:g}, "
                f"{options.u_max:g} do not ascend",
                "the published values are 0.1, 0.742, 2",
            )
        self._options = options
        self._objective = Consistency(options, context.device, "per-pixel")
        self.fields: tuple[StoreField, ...] = self._objective.fields

    @torch.no_grad()
    def append(self, view: UncertaintyView, index: int) -> None:
        """Set the map [h,w] of a new keyframe to `start`."""
        self._objective.append(view, index)
        u = view.uncertainty.new_full(view.uncertainty.shape[1:], self._options.start)
        self._objective.maps.append(view, index, u)

    @torch.no_grad()
    def update(self, view: UncertaintyView) -> UncertaintyReport:
        """One step of gradient descent on the maps of `view.frames`.

        Returns:
            The report of `Numbers.read`.
        """
        options = self._options
        if view.frames.numel() == 0:
            return UncertaintyReport()
        gradient, numbers = self._objective.gradient(view)
        before = self._objective.maps.learned(view)[view.frames]
        moved = (before - options.lr * gradient).clamp_(options.u_min, options.u_max)
        # Cells whose step is not finite keep their value.
        self._objective.maps.write(view, torch.where(torch.isfinite(moved), moved, before))
        return numbers.read()[0]

    def state_dict(self) -> dict[str, Any]:
        """What `MatchScale.state_dict` gives; all else is in the store."""
        return self._objective.scale.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`; what was kept from earlier steps is dropped."""
        self._objective.forget()
        self._objective.scale.load_state_dict(state)
