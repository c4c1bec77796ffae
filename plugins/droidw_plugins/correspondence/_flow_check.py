"""What was found between two pictures, held against them: edges, and how sure they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

from droidw_plugins.correspondence._flow_exposure import brightened
from droidw_plugins.correspondence._flow_information import (
    agreement,
    framed,
    information,
    likeness,
    sample,
    trust,
    turned,
)
from droidw_plugins.correspondence._flow_types import Array, Edge, FlowFrame, Found

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_raster import Raster
    from droidw_plugins.correspondence.flow import FlowOptions

__all__ = ["Checks"]


class Checks:
    """Judges flow by brightness, by structure, and by the way back."""

    def __init__(self, options: FlowOptions, raster: Raster) -> None:
        self._options = options
        self._raster = raster

    def gain(self, a: FlowFrame, b: FlowFrame, moved: Array | None) -> float:
        """What exposure made of brightness from `a` to `b`, if that is asked for."""
        return brightened(a, b, moved) if self._options.exposure else 1.0

    def one_way(self, a: FlowFrame, b: FlowFrame, moved: Array, gain: float) -> Edge:
        """Edge a -> b by displacements [h,w,2] px at the cells, judged by brightness."""
        agrees = agreement(a, b, moved, gain)
        agrees *= framed(a, moved, self._options.border)
        confidence = information(a, agrees, agrees, self._options)
        return Edge(self._raster.targets(moved, a), confidence, None)

    def found(
        self,
        frames: tuple[FlowFrame, FlowFrame],
        flows: tuple[Array, Array],
        starts: tuple[Array | None, Array | None],
    ) -> tuple[Found, Found]:
        """What flow there and back between these frames comes to at the cells of both."""
        (a, b), (ab, ba) = frames, flows
        return self._one_found(a, b, ab, ba, starts[0]), self._one_found(b, a, ba, ab, starts[1])

    def _one_found(
        self, a: FlowFrame, b: FlowFrame, ab: Array, ba: Array, started: Array | None
    ) -> Found:
        moved = sample(ab, a.centres)
        apart = moved + sample(ba, a.centres + moved, outside=1e4)
        share = framed(a, moved, self._options.border)
        if self._options.likeness > 0:
            pixels = self._raster.pixels(*a.grey.shape)
            gain = self.gain(a, b, moved)
            share = share * likeness(a, b, ab, pixels, self._options.likeness, gain)
        return Found(moved, apart, share, ab if self._options.turn_reach else None, started)

    def edges(
        self, frames: tuple[FlowFrame, FlowFrame], found: tuple[Found, Found]
    ) -> tuple[Edge, Edge]:
        """Both edges between these frames, from what was found there and back."""
        return self._edge(frames[0], found[0]), self._edge(frames[1], found[1])

    def _edge(self, a: FlowFrame, found: Found) -> Edge:
        """Edge from `a`, by the structure of that frame."""
        across, along = trust(found.apart, a.normal, self._options)
        across, along = across * found.share, along * found.share
        normal = None
        if found.flow is not None:
            normal = turned(a, found.flow, self._options.turn_reach)
        confidence = information(a, across, along, self._options, normal)
        return Edge(self._raster.targets(found.moved, a), confidence, found.started)
