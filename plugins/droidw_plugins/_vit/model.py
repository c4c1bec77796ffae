"""ViT with 14x14 patches as DINOv2 has it, for inference at any grid of patches.

Oquab et al., "DINOv2", 2023, and Darcet et al., "Vision transformers need registers", 2023; the
numbers are those of ../shared/parity/networks/NETWORKS.md, section 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from droidw_plugins._vit.layers import Conv2d, Linear

__all__ = ["GRID", "LARGE", "PATCH", "SMALL", "VisionTransformer", "VitSpec", "resample_positions"]

PATCH = 14
"""Pixels along the side of a patch."""

GRID = 37
"""Patches along the side of the pictures of 518x518 that all these networks were trained on."""

_EPSILON = 1e-6

Resampling = Literal["scale", "size"]


@dataclass(frozen=True)
class VitSpec:
    """Sizes of a transformer, and how it brings positions to another grid.

    Attributes:
        width: channels of a token. depth: number of blocks. heads: of attention, 64 wide each.
        registers: tokens between the class token and the patches.
        resampling: "scale" and "size", see `resample_positions`.
    """

    width: int
    depth: int
    heads: int
    registers: int = 0
    resampling: Resampling = "size"

    @property
    def prefix(self) -> int:
        """Tokens before the first patch."""
        return 1 + self.registers


SMALL = VitSpec(384, 12, 6)
"""ViT-S/14 without registers."""

LARGE = VitSpec(1024, 24, 16)
"""ViT-L/14 without registers."""


def resample_positions(grid: Tensor, height: int, width: int, how: Resampling) -> Tensor:
    """Positions [1,D,gh,gw] for another grid of patches, float32.

    "scale": bicubic interpolation at the factors (n + 0.1) / 37, which also enter the coordinates
    (official DINOv2 without registers, Metric3D). "size": bicubic with antialias between the exact
    sizes (official DINOv2 with registers, timm and so FiT3D). At 37x37 nothing is changed.

    Args:
        grid: [1,D,37,37] positions as trained.
        height, width: patches of the picture.
        how: see above; the two differ by about 1 in the tokens that come out.
    """
    if (height, width) == tuple(grid.shape[-2:]):
        return grid.float()
    if how == "size":
        return F.interpolate(
            grid.float(), size=(height, width), mode="bicubic", align_corners=False, antialias=True
        )
    scales = [(height + 0.1) / grid.shape[-2], (width + 0.1) / grid.shape[-1]]
    found = F.interpolate(
        grid.float(),
        scale_factor=scales,
        mode="bicubic",
        align_corners=False,
        recompute_scale_factor=False,
    )
    assert found.shape[-2:] == (height, width)
    return found


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = Linear(width, 3 * width)
        self.proj = Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        batch, count, width = x.shape
        split = self.qkv(x).view(batch, count, 3, self.heads, width // self.heads)
        q, k, v = split.permute(2, 0, 3, 1, 4)
        found = F.scaled_dot_product_attention(q, k, v)
        projected: Tensor = self.proj(found.transpose(1, 2).reshape(batch, count, width))
        return projected


class _Mlp(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = Linear(width, 4 * width)
        self.fc2 = Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        found: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return found


class _Scale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.empty(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class _Block(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=_EPSILON)
        self.attn = _Attention(width, heads)
        self.ls1 = _Scale(width)
        self.norm2 = nn.LayerNorm(width, eps=_EPSILON)
        self.mlp = _Mlp(width)
        self.ls2 = _Scale(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        x = x + self.ls2(self.mlp(self.norm2(x)))
        return x


class _PatchEmbed(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = Conv2d(3, width, PATCH, stride=PATCH)


class VisionTransformer(nn.Module):
    """Tokens of pictures whose sides are multiples of 14.

    `pos_embed` [1,37*37,D] holds patches alone and `cls_token` its own position already; see
    `droidw_plugins._vit.published.canonical`. The registers have no position.

    Args:
        spec: sizes.
    """

    def __init__(self, spec: VitSpec) -> None:
        super().__init__()
        self.spec = spec
        self.cls_token = nn.Parameter(torch.empty(1, 1, spec.width))
        self.pos_embed = nn.Parameter(torch.empty(1, GRID * GRID, spec.width))
        if spec.registers:
            self.register_tokens = nn.Parameter(torch.empty(1, spec.registers, spec.width))
        self.patch_embed = _PatchEmbed(spec.width)
        self.blocks = nn.ModuleList(_Block(spec.width, spec.heads) for _ in range(spec.depth))
        self.norm = nn.LayerNorm(spec.width, eps=_EPSILON)
        self._positions: tuple[tuple[int, int], Tensor] | None = None

    def positions(self, height: int, width: int) -> Tensor:
        """Positions [1,gh*gw,D] of a grid of patches, row by row; those of the last grid are kept.

        Resampled on the CPU, so that all devices agree.
        """
        kept = self._positions
        if kept is None or kept[0] != (height, width) or kept[1].device != self.pos_embed.device:
            trained = self.pos_embed.detach().cpu().transpose(1, 2)
            trained = trained.reshape(1, -1, GRID, GRID)
            found = resample_positions(trained, height, width, self.spec.resampling)
            kept = (height, width), found.flatten(2).transpose(1, 2).to(self.pos_embed.device)
            self._positions = kept
        return kept[1]

    def embed(self, images: Tensor) -> Tensor:
        """Tokens [B,prefix+gh*gw,D] before the first block: class, registers, patches row by row.

        Args:
            images: [B,3,14*gh,14*gw], normalised.
        """
        patches = self.patch_embed.proj(images).float()
        height, width = patches.shape[-2:]
        patches = patches.flatten(2).transpose(1, 2) + self.positions(height, width)
        prefix = [self.cls_token]
        if self.spec.registers:
            prefix.append(self.register_tokens)
        return torch.cat([*(p.expand(len(images), -1, -1) for p in prefix), patches], dim=1)

    def forward(self, images: Tensor) -> Tensor:
        """Tokens [B,prefix+gh*gw,D] float32 after the last block and the final normalisation."""
        tokens = self.embed(images)
        for block in self.blocks:
            tokens = block(tokens)
        found: Tensor = self.norm(tokens)
        return found
