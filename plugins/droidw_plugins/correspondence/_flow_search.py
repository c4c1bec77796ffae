"""Dense flow between two pictures by inverse search, free or from what is expected."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw_plugins.correspondence._flow_information import sample

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow_raster import Raster
    from droidw_plugins.correspondence._flow_types import Array
    from droidw_plugins.correspondence.flow import FlowOptions

__all__ = ["DenseSearch", "seen_through"]

Picture = npt.NDArray[np.uint8]

# The coarsest level of a search near its start, on which a pixel is four.
_NEAR_SCALE = 2
# Standard deviation, in sides of a patch, of what a match of the dense flow is the mean of.
_PATCH = 0.25


class DenseSearch:
    """OpenCV's dense inverse search, on any thread."""

    def __init__(self, options: FlowOptions, raster: Raster) -> None:
        self._options = options
        self._raster = raster
        self._local = threading.local()

    def __call__(
        self, a: Picture, b: Picture, start: Array | None, *, fine: bool, near: bool
    ) -> Array:
        """Flow a -> b, [H,W,2] pixels.

        Args:
            start: [H,W,2] from which patches set out; None: they stay where they are.
            fine: as for global adjustment. near: from no coarser level than the start is good for,
                or, without one, than is needed for what hardly moves.
        """
        free, started = ("still", "near") if near else ("free", "started")
        kind = free if start is None else started
        flow: Array = self._engine(kind, fine, a.shape).calc(
            a, b, None if start is None else start.copy()
        )
        return flow

    def warped(
        self,
        a: Picture,
        b: Picture,
        expected: Array,
        bend: Array | None = None,
        *,
        fine: bool,
        near: bool = False,
    ) -> Array:
        """The same, with `b` seen through the flow that is expected.

        A patch of the search moves as one. Where the camera goes forward, or passes a floor, each
        of its pixels moves by an amount of its own, and the patch is off by what its structure is
        beside its middle. Once that is taken out they all move alike, and little. What is left is
        the mean over a patch, and goes with the mean of what was expected over it. That is not what
        its middle does where flow bends, by half its variance times the bend.

        Args:
            expected: [H,W,2] pixels. bend: [H,W,2] second derivative of it; None: it has none.
            fine: as for global adjustment. near: it is known to be about right.
        """
        pixels = self._raster.pixels(*a.shape)
        rest = self(a, seen_through(b, pixels + expected), None, fine=fine, near=near)
        deviation = _PATCH * (self._options.patch_size << self._scale(fine))
        mean: Any = cv2.GaussianBlur(expected, (0, 0), deviation, borderType=cv2.BORDER_REPLICATE)
        flow: Array = rest + sample(mean, pixels + rest)
        return flow if bend is None else flow - np.float32(0.5 * deviation**2) * bend

    def _scale(self, fine: bool) -> int:
        return self._options.global_scale if fine else self._options.finest_scale

    def _engine(self, kind: str, fine: bool, shape: tuple[int, ...]) -> Any:
        """The one for this use on this thread.

        An engine remembers that it was once given a start, and answers differently ever after: with
        one for all uses the result would depend on which thread did what before.
        """
        options = self._options
        scale = self._scale(fine)
        refinement = options.global_refinement if fine else options.refinement
        name = f"{kind}-{scale}-{refinement}"
        engine: Any = getattr(self._local, name, None)
        if engine is None:
            engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
            engine.setFinestScale(scale)
            engine.setGradientDescentIterations(options.iterations)
            engine.setVariationalRefinementIterations(refinement)
            engine.setPatchSize(options.patch_size)
            engine.setPatchStride(options.patch_stride)
            room = min(shape) >> _NEAR_SCALE >= 2 * options.patch_size
            coarsest = {"still": options.again_coarsest, "near": _NEAR_SCALE if room else None}
            level = coarsest.get(kind)
            if level is not None and hasattr(engine, "setCoarsestScale"):  # from 4.13 on
                engine.setCoarsestScale(max(scale, level))
            setattr(self._local, name, engine)
        return engine


def seen_through(picture: Picture, there: Array) -> Picture:
    """What a picture [H,W] shows at the places [H,W,2], pixels, where its own would move to."""
    # OpenCV's cubic interpolation displaces a picture by up to a twentieth of a pixel.
    seen: Any = cv2.remap(
        picture, there[..., 0], there[..., 1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(seen, np.uint8)
