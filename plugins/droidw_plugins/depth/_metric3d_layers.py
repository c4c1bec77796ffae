"""The parts of Metric3D's decoder: tokens to maps, fusion, context, recurrent update.

Numbers are those of ../shared/parity/networks/NETWORKS.md, 3.2 to 3.7. The published code
rectifies some tensors in place; here that is written out where it matters.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from droidw_plugins._vit.layers import Conv2d, Linear

__all__ = [
    "ContextEncoder",
    "FeatureFusion",
    "Maps",
    "TokensToMaps",
    "UpdateBlock",
    "enlarge",
    "quarter_side",
]

Maps = tuple[Tensor, Tensor, Tensor, Tensor]
"""Maps at 1/4, 1/7, 1/14 and 1/14."""


def quarter_side(patches: int) -> int:
    """Cells of the map at "1/4", 3.5 for each patch: less than a quarter for an odd number."""
    return 7 * patches // 2


def enlarge(x: Tensor, height: int, width: int) -> Tensor:
    """Bilinear interpolation that maps corners to corners."""
    return F.interpolate(x, size=(height, width), mode="bilinear", align_corners=True)


class _ReadOut(nn.Module):
    """Patch tokens with what class token and registers say added, as a map."""

    def __init__(self, width: int, prefix: int) -> None:
        super().__init__()
        self.prefix = prefix
        self.project_patch = Linear(width, width)
        self.project_learn = Linear(prefix * width, width, bias=False)

    def forward(self, tokens: Tensor, height: int, width: int) -> Tensor:
        patches = self.project_patch(tokens[:, self.prefix :])
        whole = self.project_learn(tokens[:, : self.prefix].flatten(1))
        found = F.gelu(patches + whole[:, None]).transpose(1, 2)
        return found.reshape(len(tokens), -1, height, width)


class _Read(nn.Module):
    """A read-out and its change of size: to the quarter, to the seventh, or none."""

    def __init__(self, width: int, prefix: int, out: int = 0, scale: str = "") -> None:
        super().__init__()
        self.readoper = _ReadOut(width, prefix)
        self.sample: nn.Module | None = None
        if scale == "quarter":
            self.sample = nn.Sequential(Conv2d(width, out, 1))
        elif scale == "seventh":
            self.sample = nn.ConvTranspose2d(width, out, 2, stride=2)

    def forward(self, tokens: Tensor, height: int, width: int) -> Tensor:
        found: Tensor = self.readoper(tokens, height, width)
        return found if self.sample is None else self.sample(found)


class TokensToMaps(nn.Module):
    """Maps at 1/4, 1/7, 1/14 and 1/14 from the same tokens, each with weights of its own."""

    def __init__(self, width: int, prefix: int, maps: tuple[int, int, int]) -> None:
        super().__init__()
        self.read_0 = _Read(width, prefix, maps[0], "quarter")
        self.read_1 = _Read(width, prefix, maps[1], "seventh")
        self.read_2 = _Read(width, prefix)
        self.read_3 = _Read(width, prefix)

    def forward(self, tokens: Tensor, height: int, width: int) -> Maps:
        """Maps of tokens [B,prefix+h*w,D]."""
        # The nearest cell 3.5 times finer is i * 2 // 7. Convolution 1x1 first: it is cheaper on
        # the coarse map and gives the same.
        rows, columns = (
            torch.arange(quarter_side(n), device=tokens.device) * 2 // 7 for n in (height, width)
        )
        quarter = self.read_0(tokens, height, width)[:, :, rows][:, :, :, columns]
        return (
            quarter,
            self.read_1(tokens, height, width),
            self.read_2(tokens, height, width),
            self.read_3(tokens, height, width),
        )


class _Residual(nn.Module):
    """Two convolutions around which the *rectified* input is carried, as published."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = Conv2d(width, width, 3, padding=1)
        self.conv2 = Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = x.relu()
        change: Tensor = self.conv2(self.conv1(x).relu())
        return x + change


class _Fuse(nn.Module):
    """A step of the fusion: add a finer map, refine, enlarge."""

    def __init__(self, width: int, out: int, branch: bool = True) -> None:
        super().__init__()
        self.way_trunk = _Residual(width)
        self.way_branch = _Residual(width) if branch else None
        self.out_conv = Conv2d(width, out, 1)

    def forward(self, x: Tensor, finer: Tensor | None, size: tuple[int, int] | None) -> Tensor:
        if self.way_branch is not None and finer is not None:
            x = x + self.way_branch(finer)
        # Convolution 1x1 before the enlargement, after which it would cost more and give the same.
        found: Tensor = self.out_conv(self.way_trunk(x))
        return found if size is None else enlarge(found, *size)


class FeatureFusion(nn.Module):
    """The maps from coarse to fine become one map at 1/4 with two more channels."""

    def __init__(self, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        self.upconv_3 = _Fuse(widths[3], widths[2], branch=False)
        self.upconv_2 = _Fuse(widths[2], widths[1])
        self.upconv_1 = _Fuse(widths[1], widths[0] + 2)

    def forward(self, maps: Maps) -> Tensor:
        """[B,E+2,a,b] float32: features, confidence of the depth, kappa of the normal."""
        quarter, seventh, fourteenth, coarsest = maps
        x = self.upconv_3(coarsest, None, None)
        x = self.upconv_2(x, fourteenth, tuple(seventh.shape[-2:]))
        found: Tensor = self.upconv_1(x, seventh, tuple(quarter.shape[-2:])).float()
        return found


class _ChannelNorm(nn.LayerNorm):
    """Layer normalisation over the channels of each pixel, in float32."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.movedim(1, -1).float()).movedim(-1, 1)


class _ContextBlock(nn.Module):
    def __init__(self, inputs: int, out: int) -> None:
        super().__init__()
        self.conv1 = Conv2d(inputs, out, 3, padding=1)
        self.conv2 = Conv2d(out, out, 3, padding=1)
        self.norm1 = _ChannelNorm(out)
        self.norm2 = _ChannelNorm(out)
        self.downsample = nn.Sequential(Conv2d(inputs, out, 1), _ChannelNorm(out))

    def forward(self, x: Tensor) -> Tensor:
        y = self.norm1(self.conv1(x)).relu()
        y = self.norm2(self.conv2(y)).relu()
        found: Tensor = (self.downsample(x) + y).relu()
        return found


class ContextEncoder(nn.Module):
    """For each of three maps a start of the hidden state and an input, raw."""

    def __init__(self, maps: tuple[int, int, int], out: int) -> None:
        super().__init__()
        self.outputs04 = self._pair(maps[0], out)
        self.outputs08 = self._pair(maps[1], out)
        self.outputs16 = self._pair(maps[2], out)

    @staticmethod
    def _pair(inputs: int, out: int) -> nn.ModuleList:
        return nn.ModuleList(
            nn.Sequential(_ContextBlock(inputs, out), Conv2d(out, out, 3, padding=1))
            for _ in range(2)
        )

    def forward(self, maps: tuple[Tensor, Tensor, Tensor]) -> list[tuple[Tensor, Tensor]]:
        """(hidden, input) of the three maps."""
        heads = (self.outputs04, self.outputs08, self.outputs16)
        return [(pair[0](x), pair[1](x)) for pair, x in zip(heads, maps, strict=True)]


class _Gru(nn.Module):
    """A convolutional GRU to whose gates a context is added."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.convz = Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.convr = Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.convq = Conv2d(hidden + inputs, hidden, 3, padding=1)

    def forward(self, h: Tensor, context: tuple[Tensor, ...], *inputs: Tensor) -> Tensor:
        x = torch.cat(inputs, 1)
        both = torch.cat([h, x], 1)
        z: Tensor = (self.convz(both) + context[0]).sigmoid()
        r: Tensor = (self.convr(both) + context[1]).sigmoid()
        q: Tensor = (self.convq(torch.cat([r * h, x], 1)) + context[2]).tanh()
        return (1 - z) * h + z * q


class _Head(nn.Module):
    """Changes of depth and its confidence (d), and of normal and kappa (n)."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.conv1d = Conv2d(hidden, hidden, 3, padding=1)
        self.conv2d = Conv2d(hidden, 2, 3, padding=1)
        self.conv1n = Conv2d(hidden, hidden, 3, padding=1)
        self.conv2n = Conv2d(hidden, 4, 3, padding=1)

    def forward(self, h: Tensor) -> Tensor:
        depth = self.conv2d(self.conv1d(h).relu())
        normal = self.conv2n(self.conv1n(h).relu())
        return torch.cat([depth, normal], 1).float()


class UpdateBlock(nn.Module):
    """One iteration: the coarsest state three times, the middle twice, the finest once."""

    def __init__(self, hidden: int, state: int) -> None:
        super().__init__()
        self.gru08 = _Gru(hidden, state + hidden)
        self.gru16 = _Gru(hidden, 2 * hidden)
        self.gru32 = _Gru(hidden, hidden)
        self.flow_head = _Head(hidden)
        self.mask = nn.Sequential(
            Conv2d(hidden, hidden, 3, padding=1), nn.ReLU(), Conv2d(hidden, 144, 1)
        )

    def forward(
        self, hidden: list[Tensor], context: list[tuple[Tensor, ...]], state: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """New hidden states, and the change [B,6,a,b] of the state; `hidden` is not changed."""
        h0, h1, h2 = hidden
        from_fine = enlarge(_pool(h0), *h1.shape[-2:])
        for step in range(3):
            h2 = self.gru32(h2, context[2], _pool(h1))
            if step >= 1:
                h1 = self.gru16(h1, context[1], from_fine, enlarge(h2, *h1.shape[-2:]))
        h0 = self.gru08(h0, context[0], state.to(h1.dtype), enlarge(h1, *h0.shape[-2:]))
        change: Tensor = self.flow_head(h0)
        return [h0, h1, h2], change


def _pool(x: Tensor) -> Tensor:
    """Means over 3x3 at every second cell; zeros outside count."""
    return F.avg_pool2d(x, 3, stride=2, padding=1)
