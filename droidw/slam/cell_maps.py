"""What features, the depth prior and the user's mask say of the cells of one frame."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from droidw.geometry.transfer import upload
from droidw.interfaces.features import KnowsMovable
from droidw.slam.contract import depth_of, features_of, movable_of
from droidw.solve.weights import unmasked

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid
    from droidw.slam.frame import Frame
    from droidw.slam.optimise import Parts
    from droidw.slam.timing import Stopwatch

__all__ = ["CellMaps"]

# Share of the median depth of a map up to which a depth is none: what is so near fills no cell.
_NO_DEPTH = 1e-3


class CellMaps:
    """Asks the parts of a run for maps of a frame; keeps nothing of it.

    Args:
        parts: the plugins, built.
        grid: of the cells.
        picked: the same, where features and depth are to be taken.
        device: where the maps are wanted.
        clock: where the time of each part is added up.
    Attributes:
        parts: those that are asked.
    """

    def __init__(
        self, parts: Parts, grid: Grid, picked: Grid, device: torch.device, clock: Stopwatch
    ) -> None:
        self.parts = parts
        self._grid = grid
        self._picked = picked
        self._device = device
        self._clock = clock

    def features(self, frame: Frame) -> Tensor:
        """[C,h,w] of the extractor."""
        with self._clock("features"):
            extractor, image = self.parts.features, upload(frame.image, self._device)
            return features_of(extractor.extract(image, self._picked), extractor.dim, self._picked)

    def movable(self, frame: Frame) -> Tensor | None:
        """[h,w] in [0,1], how much speaks for what can move; None where nobody knows."""
        extractor = self.parts.features
        if not isinstance(extractor, KnowsMovable):
            return None
        with self._clock("features"):
            image = upload(frame.image, self._device)
            return movable_of(extractor.movable(image, self._picked), self._picked)

    def prior(self, frame: Frame) -> Tensor:
        """[h,w] inverse depth, 0 where it is not known."""
        with self._clock("depth prior"):
            blank = torch.zeros(self._grid.height, self._grid.width, device=self._device)
            predicted = depth_of(self.parts.depth.predict(frame), *frame.image.shape[1:])
            if predicted is None:
                return blank
            depth = self._picked.sample(upload(predicted, self._device), mode="nearest")
            known = torch.isfinite(depth) & (depth > 0)
            # Holes may be filled with next to nothing, and one of them would outweigh a map.
            known &= depth > _NO_DEPTH * _median(depth, known)
            return torch.where(known, 1.0 / depth.clamp_min(1e-6), blank)

    def unmasked(self, frame: Frame) -> Tensor:
        """[h,w] in [0,1], what the frame's mask leaves of each cell."""
        if frame.mask is None:
            return torch.ones(self._grid.height, self._grid.width, device=self._device)
        return unmasked(self._grid.covered(upload(frame.mask, self._device)))


def _median(values: Tensor, known: Tensor) -> Tensor:
    """The median [1] of those values that are known, infinite if none is: no host waits for it."""
    ordered = torch.where(known, values, math.inf).flatten().sort().values
    middle = torch.div(known.sum() - 1, 2, rounding_mode="floor").clamp_min(0)
    return ordered.gather(0, middle[None])
