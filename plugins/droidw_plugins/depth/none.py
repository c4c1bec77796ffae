"""Depth prior `none`: depth comes from the motion of the camera alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component, NoOptions

if TYPE_CHECKING:
    from droidw.interfaces.depth import DepthMap, DepthPrior
    from droidw.slam.frame import Frame

__all__ = ["COMPONENT", "NoDepth"]


class NoDepth:
    """A prior that knows nothing; the scale of the result is then arbitrary."""

    metric = False

    def predict(self, frame: Frame) -> DepthMap | None:
        """None for every frame."""
        return None


def _build(options: NoOptions, context: BuildContext) -> NoDepth:
    return NoDepth()


COMPONENT: Component[DepthPrior] = Component(
    name="none",
    summary="no depth prior; the scale of the result is arbitrary",
    factory=_build,
    capabilities=frozenset({"cpu", "cuda"}),
)
