"""Pictures matched again, by windows in the second one as it looks through what is predicted.

Once a path is known to a few pixels, and a pair was searched, there is nothing left to search for:
a window per cell goes on from the match that is there, for a fifth of the time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from droidw_plugins.correspondence._flow_exposure import as_bright
from droidw_plugins.correspondence._flow_information import sample
from droidw_plugins.correspondence._flow_polish import SMALLEST, polished, polished_through
from droidw_plugins.correspondence._flow_search import seen_through
from droidw_plugins.correspondence._flow_types import Array, Edge, FlowFrame, set_out_from

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_raster import Raster
    from droidw_plugins.correspondence.flow import FlowOptions

__all__ = ["Windows", "but_for_closed"]

Picture = npt.NDArray[np.uint8]

# Cells by which predictions may have moved, in the median, since a pair was searched.
_MOVED = 0.5
# Confidence that a match has at least, and pixels that it is at most from what is predicted, for a
# window to set out from it; else it sets out from what is predicted.
_SURE, _NEAR = 0.02, 4.0


class Windows:
    """Matches of pictures once more."""

    def __init__(self, options: FlowOptions, raster: Raster) -> None:
        self._options = options
        self._raster = raster
        self.fill = options.warp and options.fill_window >= SMALLEST
        self._again = options.warp and options.again_window >= SMALLEST

    def suffice(self, known: tuple[Edge, Edge], starts: tuple[Array | None, Array | None]) -> bool:
        """Whether a pair need not be searched again: what is predicted was about the same."""
        predicted = all(start is not None for start in starts)
        return self._again and predicted and set_out_from(known, starts, _MOVED)

    def cells(self, a: FlowFrame, b: FlowFrame, gain: float, start: Array, before: Array) -> Array:
        """Displacements [h,w,2] px at the cells of `a` to a frame between keyframes, once more.

        Args:
            gain: of brightness, from `a` to `b`. start: targets [h,w,2] that are predicted, cells.
            before: [h,w,2] px that were found.
        """
        expected, seen = self._seen(a, b, gain, start)
        window = self._options.fill_window
        return polished_through(a.grey, seen, a.centres, before, expected, window)

    def dense(self, a: FlowFrame, b: FlowFrame, gain: float, start: Array, edge: Edge) -> Array:
        """Flow a -> b, [H,W,2] px, from matches that were found before; other arguments as above.

        Between cells what is predicted is off by as much as beside them.
        """
        expected, seen = self._seen(a, b, gain, start)
        rest = self._raster.moved(edge.target, a) - sample(expected, a.centres)
        sets_out = edge.confidence[..., :2].max(axis=-1) > _SURE
        sets_out &= np.abs(rest).max(axis=-1) < _NEAR
        rest = np.where(sets_out[..., None], rest, np.float32(0))
        rest = polished(a.grey, seen, a.centres, rest, self._options.again_window)
        beside = self._raster.between(rest, *a.grey.shape)
        return beside + sample(expected, self._raster.pixels(*a.grey.shape) + beside)

    def _seen(self, a: FlowFrame, b: FlowFrame, gain: float, start: Array) -> tuple[Array, Picture]:
        """Flow that is expected, [H,W,2] px, and `b` as it looks through that."""
        curved = self._options.curved
        expected = self._raster.dense(start, a, settled=True, curved=curved).flow
        there = self._raster.pixels(*a.grey.shape) + expected
        return expected, seen_through(as_bright(b.grey, gain), there)


def but_for_closed(
    edge: Edge, before: Edge, closed: npt.NDArray[np.bool_] | None, share: float
) -> Edge:
    """The edge, with what was found before in cells [h,w] that are closed.

    Args:
        share: of their confidence that these keep, if they were not closed before.
    """
    if closed is None:
        return replace(edge, seeded=before.seeded)
    again = np.ones_like(closed) if before.bridged is None else ~before.bridged
    kept = np.where(again[..., None], np.float32(share) * before.confidence, before.confidence)
    return replace(
        edge,
        target=np.where(closed[..., None], before.target, edge.target),
        confidence=np.where(closed[..., None], kept, edge.confidence),
        bridged=closed,
        seeded=before.seeded,
    )
