"""Feature extractors: what the uncertainty model compares between views."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.geometry.camera import Grid

__all__ = ["FeatureExtractor", "KnowsMovable"]


@runtime_checkable
class FeatureExtractor(Protocol):
    """Turns an image into one feature vector per grid cell.

    Attributes:
        dim: number of channels C; 0 for the extractor `none`.

    An extractor may also have `dtype`, the type of what `extract` returns, torch.float32 or
    torch.float16: keyframes then keep features in it. Without it they keep float32.

    It may also have `calibrated`: true if the cosine of its features is on droidw's scale already
    (at measured matches three quarters are above 0.895 and half above 0.93, docs/features.md).
    Uncertainty models then take it as it is; without it they bring it there themselves.

    And it may be one that `KnowsMovable`.
    """

    dim: int

    def extract(self, image: Tensor, grid: Grid) -> Tensor:
        """Features sampled at the pixel centres of the grid's cells.

        Args:
            image: [3,H,W] float32 in [0,1], RGB, at working size.
            grid: where to sample; cell (x, y) lies at pixel `stride * (x, y) + offset`.
        Returns:
            [C,h,w] float32 or float16, finite, on the device of `image`; raw, not normalised.
        """
        ...


@runtime_checkable
class KnowsMovable(Protocol):
    """What an extractor may offer besides: which cells show something that can move by itself.

    Uncertainty models may start from that (`Begins`), and correspondence may leave it out where it
    asks how far a picture moved (`SetsAside`); nobody needs it.
    """

    def movable(self, image: Tensor, grid: Grid) -> Tensor:
        """How much speaks for a person, an animal or a vehicle, whether it moves or not.

        Args:
            image, grid: as of `FeatureExtractor.extract`.
        Returns:
            [h,w] float32 from 0 (nothing) to 1, on the device of `image`.
        """
        ...
