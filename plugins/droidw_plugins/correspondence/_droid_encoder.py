"""The two encoders of the DROID network (REFERENCE 1.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from droidw.geometry.transfer import on_device

__all__ = ["Encoder", "normalise"]

_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


def normalise(images: Tensor) -> Tensor:
    """RGB in [0,1], [...,3,H,W], as the encoders take it (REFERENCE 1.1); float32."""
    mean = on_device(_MEAN, images.device, torch.float32)[:, None, None]
    std = on_device(_STD, images.device, torch.float32)[:, None, None]
    return (images.float() - mean) / std


def _norm(x: Tensor) -> Tensor:
    """Every channel of every picture to mean 0 and variance 1 (eps 1e-5)."""
    if x.is_cuda:
        return F.instance_norm(x)
    # Sums down the rows of [pixels, channels] are quick and exact with channels last, where
    # torch's own takes ten times as long.
    rows = x.permute(0, 2, 3, 1).float()
    centred = rows - rows.flatten(1, 2).mean(1)[:, None, None]
    variance = (centred * centred).flatten(1, 2).mean(1)[:, None, None]
    return centred.mul_((variance + 1e-5).rsqrt()).to(x.dtype).permute(0, 3, 1, 2)


class _Block(nn.Module):
    """Two 3x3 convolutions beside the identity, or beside a strided 1x1 convolution."""

    def __init__(self, into: int, out: int, stride: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(into, out, 3, stride=stride, padding=1)
        self.conv2 = nn.Conv2d(out, out, 3, padding=1)
        if stride != 1:
            self.downsample = nn.Sequential(nn.Conv2d(into, out, 1, stride=stride))
        self._strided, self._norm = stride != 1, norm

    def forward(self, x: Tensor) -> Tensor:
        """The residual sum, [B,out,H/stride,W/stride]; both branches end in a ReLU."""
        y = self.conv1(x)
        y = F.relu(_norm(y) if self._norm else y, inplace=True)
        y = self.conv2(y)
        y = F.relu(_norm(y) if self._norm else y, inplace=True)
        if self._strided:
            x = self.downsample(x)
            x = _norm(x) if self._norm else x
        return F.relu(y.add_(x), inplace=True)


class Encoder(nn.Module):
    """Pictures [B,3,H,W] to maps [B,out,ceil(H/8),ceil(W/8)]; names as in the published file.

    Cell (x, y) has its receptive field centred at pixel (8 x, 8 y).

    Args:
        out: channels. norm: normalise every channel of a picture (the feature encoder) or nothing
            (the context encoder).
    """

    def __init__(self, out: int, norm: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 32, 7, stride=2, padding=3)
        self.layer1 = nn.Sequential(_Block(32, 32, 1, norm), _Block(32, 32, 1, norm))
        self.layer2 = nn.Sequential(_Block(32, 64, 2, norm), _Block(64, 64, 1, norm))
        self.layer3 = nn.Sequential(_Block(64, 128, 2, norm), _Block(128, 128, 1, norm))
        self.conv2 = nn.Conv2d(128, out, 1)
        self._norm = norm

    def forward(self, images: Tensor) -> Tensor:
        """Encode normalised pictures."""
        x = self.conv1(images.contiguous(memory_format=torch.channels_last))
        x = F.relu(_norm(x) if self._norm else x, inplace=True)
        x = self.layer3(self.layer2(self.layer1(x)))
        encoded: Tensor = self.conv2(x)
        return encoded
