"""What a classifier of photographs says of what can move by itself.

EfficientNet-Lite0 was trained on the thousand classes of ILSVRC 2012. Its last layers are applied
to every place instead of the mean of all (Oquab et al., "Is object localization for free?", CVPR
2015), and what they say for animals, for vehicles and for what people wear is added up. This is
coarse, wide of the contours, and only says what could move: enough to begin with, before any motion
is known.

Half of the classes are such. Before a bare wall all of them are about as likely, and their
probabilities add up to a half, though nothing at all was seen. So what counts is the information:
by how much the probabilities of these classes are above those of a picture that says nothing.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw_plugins.features._efficientnet import BLOCKS, load_classifier
from droidw_plugins.features._patches import sample_at_cells

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid

__all__ = ["MOVABLE", "MovableClassifier"]

# Pixels of a cell of the last layers.
_STRIDE = 32

_ANIMALS = range(398)
_VEHICLES = (
    403, 404, 405, 407, 408, 436, 444, 466, 468, 472, 479, 511, 547, 555, 561, 569, 573, 575, 581,
    603, 609, 612, 627, 654, 656, 661, 665, 670, 671, 675, 690, 705, 717, 734, 751, 757, 779, 802,
    803, 814, 817, 820, 829, 847, 864, 866, 867, 870, 874, 880, 914,
)  # fmt: skip
_WORN = (
    399, 400, 411, 433, 439, 445, 451, 452, 457, 459, 465, 474, 501, 502, 514, 515, 518, 560, 568,
    578, 601, 608, 610, 614, 615, 617, 630, 638, 639, 643, 652, 655, 658, 667, 678, 689, 697, 735,
    770, 774, 775, 793, 796, 801, 806, 808, 834, 836, 837, 841, 842, 869, 887, 903, 906, 981, 982,
    983,
)  # fmt: skip
MOVABLE: tuple[int, ...] = (*_ANIMALS, *_VEHICLES, *_WORN)
"""Classes of ILSVRC 2012 (in the usual order, from 0): animals, vehicles, and what people wear."""


class MovableClassifier:
    """The classifier of EfficientNet-Lite0 at every place of a picture.

    Args:
        path: of its published weights.
        device: where to compute.
        information: whether the information p log(n p) of these classes, of n in all, counts, as a
            share of the most there can be, log n; otherwise their probability p.
        scales: times the size of the picture at which it looks; the largest answer counts. What
            is small is only known enlarged, and of what is large only parts are seen then.
    Raises:
        MissingRequirementError: the weights are missing or do not fit.
    """

    def __init__(
        self, path: Path, device: torch.device, scales: tuple[float, ...], information: bool
    ) -> None:
        self._trunk, self._head, self._classes = load_classifier(path, len(BLOCKS) - 1, device)
        movable = torch.zeros(self._classes.weight.shape[0], device=device)
        movable[list(MOVABLE)] = 1.0
        self._movable = movable[:, None, None]
        self._scales = scales
        self._information = information

    @torch.no_grad()
    def __call__(self, image: Tensor, grid: Grid) -> Tensor:
        """How much speaks for it that a cell shows what can move by itself, [h,w] in [0,1].

        Args:
            image: [3,H,W], normalised as the network wants it.
            grid: of the cells.
        """
        return torch.stack([self._at(scale, image, grid) for scale in self._scales]).amax(0)

    def _at(self, scale: float, image: Tensor, grid: Grid) -> Tensor:
        height, width = (
            max(round(side * scale / _STRIDE), 1) * _STRIDE for side in image.shape[1:]
        )
        large = F.interpolate(image[None], (height, width), mode="bilinear", align_corners=False)
        seen = F.relu6(self._head(self._trunk(large)[0]))
        share = self._evidence(self._classes(seen).log_softmax(1))
        size = tuple(image.shape[1:])
        if _even(grid, size):  # the same, in one call
            cells = (grid.height, grid.width)
            return F.interpolate(share, cells, mode="bilinear", align_corners=False)[0, 0]
        return sample_at_cells(share[0], size, grid)[0]

    def _evidence(self, log_p: Tensor) -> Tensor:
        """Evidence [B,1,...] for classes that move, from logarithms of probabilities [B,n,...]."""
        p = log_p.exp()
        if not self._information:
            return (p * self._movable).sum(1, keepdim=True)
        most = math.log(log_p.shape[1])
        told: Tensor = (p * (log_p + most) * self._movable).sum(1, keepdim=True)
        return (told / most).clamp(0.0, 1.0)


def _even(grid: Grid, size: tuple[int, ...]) -> bool:
    """Whether cells part a picture of H, W evenly, each around its centre."""
    covered = (grid.height * grid.stride, grid.width * grid.stride)
    return covered == size and grid.offset == (grid.stride - 1) / 2
