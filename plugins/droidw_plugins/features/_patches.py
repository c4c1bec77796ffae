"""The extractor behind `fit3d` and `dinov2`: patch tokens, sampled at the grid's cells."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.errors import InputError
from droidw.geometry.transfer import upload
from droidw.io.weights import fingerprint
from droidw.plugin.component import BuildContext
from droidw.plugin.weights import WeightsFile
from droidw.slam.frame import is_blank
from droidw_plugins._vit.layers import choose_dtype, exact
from droidw_plugins._vit.model import PATCH
from droidw_plugins._vit.published import blaming, load_transformer, read_published
from droidw_plugins.features._calibration import Calibration, from_picture, of_nothing
from droidw_plugins.features._efficientnet import ChannelStatistics
from droidw_plugins.features._patch_options import PatchOptions

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid

__all__ = ["PatchFeatures", "patch_grid", "sample_at_cells"]

_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


class PatchFeatures:
    """Tokens of the patches of a ViT-S/14 after the final normalisation (REFERENCE 4.1).

    The picture is normalised, brought to sides that are multiples of 14, and the map of its
    patches is sampled straight at the cells; raw, unless a calibration is asked for.

    Args:
        record: of the weights: which network it is.
        options: see `PatchOptions`.
        context: device, and the folder of weights.
    Attributes:
        dim: channels of the result.
        dtype: of the result, in which the keyframe store keeps it.
        weights_sha256: of a checkpoint that the options name, for the manifest; else "".
    Raises:
        ConfigError: float16 products are asked for on a CPU.
        MissingRequirementError: the weights are missing.
        InputError: the weights are damaged, or of another network.
    """

    def __init__(self, record: WeightsFile, options: PatchOptions, context: BuildContext) -> None:
        self._device = context.device
        self._product = choose_dtype(
            options.precision, context.device, "features.options.precision"
        )
        path, state = read_published(record, options.weights, context.weights_dir)
        with blaming(path):
            self._network = load_transformer(record, state, context.device, self._product)
        self.weights_sha256 = fingerprint(path) if options.weights else ""
        self._options = options
        self._mean = torch.tensor(_MEAN, device=context.device)[:, None, None]
        self._std = torch.tensor(_STD, device=context.device)[:, None, None]
        self._calibration: Calibration | None = None
        width = self._network.spec.width
        calibrated = options.calibration == "picture"
        self.dim = width + 1 if calibrated and options.constant > 0 else width
        self.dtype: torch.dtype = getattr(torch, options.dtype)

    @torch.no_grad()
    def extract(self, image: Tensor, grid: Grid) -> Tensor:
        """Features [C,h,w] of one image [3,H,W] in [0,1], RGB; see `FeatureExtractor.extract`.

        Raises:
            InputError: the image has a side of less than 14 pixels.
        """
        found = sample_at_cells(self.patches(image), tuple(image.shape[-2:]), grid)
        if self._options.calibration == "picture":
            found = self._calibrated(found, image)
        return found.to(self.dtype)

    @torch.no_grad()
    def patches(self, image: Tensor) -> Tensor:
        """The map of patch tokens [C,gh,gw] float32 of one image [3,H,W] in [0,1], RGB."""
        x = self.network_input(image)
        tokens = self.tokens(x)[0, self._network.spec.prefix :]
        return tokens.T.reshape(-1, x.shape[2] // PATCH, x.shape[3] // PATCH)

    def network_input(self, image: Tensor) -> Tensor:
        """What the network is shown, [1,3,14*gh,14*gw]: normalised first, then resized."""
        height, width = patch_grid(image.shape[-2], image.shape[-1], self._options.long_side)
        x = ((upload(image, self._device) - self._mean) / self._std)[None]
        size = (height * PATCH, width * PATCH)
        if tuple(image.shape[-2:]) == size:
            return x
        return F.interpolate(x, size=size, mode="bilinear", align_corners=False)

    @torch.no_grad()
    def tokens(self, x: Tensor) -> Tensor:
        """All tokens [1,prefix+gh*gw,C] float32 of a network input."""
        with exact(self._product, self._device):
            found: Tensor = self._network(x)
        return found

    def state_dict(self) -> dict[str, Any]:
        """The calibration taken from a picture; empty without one."""
        return {} if self._calibration is None else self._calibration.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`, so that features compare with those of the run that made it."""
        if state:
            self._calibration = Calibration(
                state["matrix"].to(self._device),
                state["mean"].to(self._device),
                self._options.constant,
                1.0,
            )

    def _calibrated(self, features: Tensor, image: Tensor) -> Tensor:
        calibration = self._calibration
        if calibration is None:
            if is_blank(image):
                like = features.new_empty(self.dim, *features.shape[1:])
                return of_nothing(like, self._options.constant, 1.0)
            flat = features.flatten(1)
            spread = ChannelStatistics(flat.mean(1), flat.std(1).clamp_min(1e-3))
            calibration = self._calibration = from_picture(
                [features],
                [spread],
                (1.0,),
                self._options.shrinkage,
                None,
                self._options.constant,
                1.0,
            )
        return calibration(features)


def patch_grid(height: int, width: int, long_side: int = 0) -> tuple[int, int]:
    """Rows and columns of whole patches of a picture, enlarged or reduced to `long_side` (0: not).

    Raises:
        InputError: not a single patch fits.
    """
    scale = long_side / max(height, width) if long_side else 1.0
    # A hair more, so that 14 * n * (a / b) is not lost to rounding.
    rows, columns = (math.floor(side * scale / PATCH + 1e-9) for side in (height, width))
    if rows < 1 or columns < 1:
        raise InputError(
            f"a picture of {width}x{height} pixels is too small for patches of {PATCH}x{PATCH}",
            "give larger pictures, a larger camera.long_side"
            + (f", or features.options.long_side above {long_side}" if long_side else ""),
        )
    return rows, columns


def sample_at_cells(patches: Tensor, size: tuple[int, ...], grid: Grid) -> Tensor:
    """The map [C,gh,gw] of patches at the cells, [C,h,w].

    The same as enlarging the map to the picture bilinearly (corners not aligned) and reading it
    at the cells, without the large map. The published code reads pixels 3, 11, 19, ...: a grid of
    stride 8 and offset 3 gives exactly that (REFERENCE 4.1).

    Args:
        patches: of the whole picture.
        size: (H,W) of the picture.
        grid: where to sample.
    """

    def axis(count: int, cells: int, side: int) -> tuple[Tensor, Tensor, Tensor]:
        pixel = torch.arange(cells, dtype=torch.float64, device=patches.device)
        pixel = pixel * grid.stride + grid.offset
        where = ((pixel + 0.5) * count / side - 0.5).clamp(0, count - 1)
        low = where.floor().long().clamp_max(max(count - 2, 0))
        high = (low + 1).clamp_max(count - 1)
        share = (where - low).to(patches.dtype)
        return low, high, share

    low, high, share = axis(patches.shape[1], grid.height, size[0])
    rows = torch.lerp(patches[:, low], patches[:, high], share[:, None])
    low, high, share = axis(patches.shape[2], grid.width, size[1])
    return torch.lerp(rows[:, :, low], rows[:, :, high], share)
