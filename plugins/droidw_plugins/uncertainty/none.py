"""Uncertainty model `none`: every cell is trusted fully."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from droidw.interfaces.uncertainty import StoreField, UncertaintyReport, UncertaintyView
from droidw.plugin.component import BuildContext, Component, NoOptions

if TYPE_CHECKING:
    from droidw.interfaces.uncertainty import UncertaintyModel

__all__ = ["COMPONENT", "NoUncertainty"]


class NoUncertainty:
    """u = 0 everywhere, which every gate turns into a weight of one."""

    fields: tuple[StoreField, ...] = ()

    def append(self, view: UncertaintyView, index: int) -> None:
        """Set the map [h,w] of a new keyframe to zero."""
        view.uncertainty[index] = 0.0

    def update(self, view: UncertaintyView) -> UncertaintyReport:
        """Change nothing; the report is empty."""
        return UncertaintyReport()

    def state_dict(self) -> dict[str, Any]:
        """An empty state."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""


def _build(options: NoOptions, context: BuildContext) -> NoUncertainty:
    return NoUncertainty()


COMPONENT: Component[UncertaintyModel] = Component(
    name="none",
    summary="every pixel is trusted; plain bundle adjustment",
    factory=_build,
    capabilities=frozenset({"cpu", "cuda"}),
)
