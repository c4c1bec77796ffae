"""Feature extractor `none`: no features at all, for runs without an uncertainty model."""

from __future__ import annotations

from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component, NoOptions

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.geometry.camera import Grid
    from droidw.interfaces.features import FeatureExtractor

__all__ = ["COMPONENT", "NoFeatures"]


class NoFeatures:
    """An extractor without channels: costs nothing and satisfies the interface."""

    dim = 0

    def extract(self, image: Tensor, grid: Grid) -> Tensor:
        """An empty tensor [0,h,w] on the device of `image` ([3,H,W])."""
        return image.new_empty((0, grid.height, grid.width))


def _build(options: NoOptions, context: BuildContext) -> NoFeatures:
    return NoFeatures()


COMPONENT: Component[FeatureExtractor] = Component(
    name="none",
    summary="no features; for uncertainty models that need none",
    factory=_build,
    capabilities=frozenset({"cpu", "cuda"}),
)
