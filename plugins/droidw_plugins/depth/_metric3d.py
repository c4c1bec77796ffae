"""The prior behind `metric3d`: a picture into the canonical camera, its depth back in metres."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.errors import ConfigError, InputError
from droidw.geometry.transfer import upload
from droidw.interfaces.depth import DepthMap
from droidw.io.weights import fingerprint
from droidw.plugin.component import BuildContext
from droidw.plugin.weights import WeightsFile
from droidw_plugins._vit.layers import choose_dtype, exact
from droidw_plugins._vit.published import blaming, read_published
from droidw_plugins.depth._metric3d_net import load_metric3d
from droidw_plugins.depth.metric3d import Metric3dOptions

if TYPE_CHECKING:
    from droidw.slam.frame import Frame

__all__ = ["Fit", "Metric3dDepth", "fit_into"]

_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)
_MULTIPLE = 28  # of the sides: then the network's maps have the size of its input
_FOCAL = 1000.0  # of the canonical camera, in pixels
_FARTHEST = 300.0  # metres


class Fit(NamedTuple):
    """How a picture lies in the input of the network.

    Attributes:
        scale: pixels of the input per pixel of the picture.
        height, width: of the resized picture. top, left: where it starts; zeros around it.
    """

    scale: float
    height: int
    width: int
    top: int
    left: int


def fit_into(height: int, width: int, size: tuple[int, int]) -> Fit:
    """Fit a picture into an input of `size` (height, width), keeping its shape.

    Raises:
        InputError: it is so long and narrow that nothing is left of it.
    """
    scale = min(size[0] / height, size[1] / width)
    rows, columns = int(height * scale), int(width * scale)
    if rows < 1 or columns < 1:
        raise InputError(
            f"a picture of {width}x{height} pixels is too narrow for the depth prior 'metric3d', "
            f"which fits it into {size[1]}x{size[0]}",
            "give pictures of another shape, or run without a depth prior: depth=none",
        )
    return Fit(scale, rows, columns, (size[0] - rows) // 2, (size[1] - columns) // 2)


class Metric3dDepth:
    """Depth in metres of single pictures, by Metric3D v2.

    The network gives depth for a camera of focal length 1000 px. A picture that was resized by s
    to fit its input was taken with s * fx, so that its depth is the network's times s * fx / 1000.
    The published system multiplies by the fx of the raw picture instead, whatever it was reduced
    to (REFERENCE 3.6); `compat=[droid-w]` does the same, and `metric` is then False.

    Args:
        record: of the weights. options: see `Metric3dOptions`.
        context: device, folder of weights, and for `droid-w` the camera of the raw pictures.
    Attributes:
        metric: whether depths are in metres.
        weights_sha256: of a checkpoint that the options name, for the manifest; else "".
    Raises:
        ConfigError: an input size that the network cannot have, float16 on a CPU, or `droid-w`
            where the raw camera is not known.
        MissingRequirementError: the weights are missing.
        InputError: the weights are damaged, or of another network.
    """

    def __init__(
        self, record: WeightsFile, options: Metric3dOptions, context: BuildContext
    ) -> None:
        size = options.size
        if len(size) != 2 or any(side < _MULTIPLE or side % _MULTIPLE for side in size):
            raise ConfigError(
                f"depth.options.size: {list(size)} is not a size that the network can have",
                f"valid: [height, width], both multiples of {_MULTIPLE}, e.g. [616,1064] as "
                "published, or [308,532]",
            )
        self._size = (size[0], size[1])
        self._device = context.device
        self._product = choose_dtype(options.precision, context.device, "depth.options.precision")
        self._factor: float | None = None
        if "droid-w" in context.compat:
            if context.camera is None:
                raise ConfigError(
                    "compat: 'droid-w' scales depth by the focal length of the raw pictures, "
                    "which is not known here",
                    "give BuildContext(camera=...), or leave compat=[droid-w] out for metres",
                )
            self._factor = context.camera.fx / _FOCAL
        self.metric = self.goes_with_focal = self._factor is None
        path, state = read_published(record, options.weights, context.weights_dir)
        with blaming(path):
            self._network = load_metric3d(options.variant, state, context.device, self._product)
        self.weights_sha256 = fingerprint(path) if options.weights else ""
        self._mean = torch.tensor(_MEAN, device=context.device)[:, None, None]
        self._std = torch.tensor(_STD, device=context.device)[:, None, None]

    @torch.no_grad()
    def predict(self, frame: Frame) -> DepthMap:
        """Depth [H,W] of a frame in metres, at most 300; 0 where the enlargement undershot.

        Raises:
            InputError: the picture is far too narrow.
        """
        height, width = frame.image.shape[-2:]
        fit = fit_into(height, width, self._size)
        found = self.canonical_depth(self.network_input(frame.image))
        found = found[..., fit.top : fit.top + fit.height, fit.left : fit.left + fit.width]
        found = F.interpolate(found, size=(height, width), mode="bicubic", align_corners=False)
        factor = self._factor
        if factor is None:
            factor = float(frame.intrinsics[0]) * fit.scale / _FOCAL
        return DepthMap((found[0, 0] * factor).clamp(0.0, _FARTHEST))

    def network_input(self, image: Tensor) -> Tensor:
        """What the network is shown, [1,3,h,w]: resized, normalised, then padded with zeros."""
        fit = fit_into(image.shape[-2], image.shape[-1], self._size)
        x = F.interpolate(
            upload(image, self._device)[None],
            size=(fit.height, fit.width),
            mode="bilinear",
            align_corners=False,
        )
        right, below = self._size[1] - fit.width - fit.left, self._size[0] - fit.height - fit.top
        return F.pad((x - self._mean) / self._std, (fit.left, right, fit.top, below))

    @torch.no_grad()
    def canonical_depth(self, x: Tensor) -> Tensor:
        """Depth [1,1,h,w] of a network input in the camera of focal length 1000 px."""
        with exact(self._product, self._device):
            found: Tensor = self._network(x).depth
        return found
