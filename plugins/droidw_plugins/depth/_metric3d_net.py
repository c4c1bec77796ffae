"""Metric3D v2 (ViT): depth in the canonical camera, its confidence, and normals, of one picture.

Hu et al., "Metric3D v2", 2024; the numbers are those of ../shared/parity/networks/NETWORKS.md,
section 3. Modules are named as in the published checkpoint, and these names are historical:
`outputs04`, `outputs08`, `outputs16` and `gru08`, `gru16`, `gru32` belong to the maps at 1/4, 1/7
and 1/14 of the picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from droidw.plugin.weights import WeightsFile
from droidw_plugins._vit.layers import Conv2d, build
from droidw_plugins._vit.model import LARGE, PATCH, SMALL, VisionTransformer, VitSpec
from droidw_plugins._vit.published import (
    canonical,
    check_shapes,
    floats,
    transformer_shapes,
)
from droidw_plugins._weights import METRIC3D_VIT_LARGE, METRIC3D_VIT_SMALL
from droidw_plugins.depth._metric3d_layers import (
    ContextEncoder,
    FeatureFusion,
    Maps,
    TokensToMaps,
    UpdateBlock,
)

__all__ = [
    "SIZES",
    "Estimate",
    "Metric3d",
    "Metric3dSpec",
    "check_vit_large",
    "check_vit_small",
    "load_metric3d",
    "published_shapes",
]

_NEAREST, _FARTHEST = 0.1, 200.0  # of the depth, in the canonical camera
_SHIFT, _SPREAD = 200.0, 100.0  # of the depth inside the state

_ENCODER, _DECODER = "depth_model.encoder.", "depth_model.decoder."
_UNUSED = _ENCODER + "mask_token"  # may be absent from the published files: NETWORKS.md, 4


@dataclass(frozen=True)
class Metric3dSpec:
    """Sizes of a network.

    Attributes:
        encoder: of the transformer.
        maps: channels of the maps at 1/4, 1/7 and 1/14.
        hidden: channels of hidden states and context.
        iterations: of the refinement.
        record: of the published weights.
    """

    encoder: VitSpec
    maps: tuple[int, int, int]
    hidden: int
    iterations: int
    record: WeightsFile


def _with_registers(spec: VitSpec) -> VitSpec:
    # Registers, and yet positions resampled as in the DINOv2 without: so it was trained.
    return VitSpec(spec.width, spec.depth, spec.heads, registers=4, resampling="scale")


SIZES: Mapping[str, Metric3dSpec] = {
    "vit-small": Metric3dSpec(_with_registers(SMALL), (96, 192, 384), 48, 4, METRIC3D_VIT_SMALL),
    "vit-large": Metric3dSpec(_with_registers(LARGE), (256, 512, 1024), 128, 8, METRIC3D_VIT_LARGE),
}
"""Variant -> sizes."""


class Estimate(NamedTuple):
    """What the network says of pictures; float32.

    Attributes:
        depth: [B,1,H,W] in [0.1, 200], in the canonical camera of focal length 1000 px.
        confidence: [B,1,H,W] unbounded, larger is more certain.
        normal: [B,4,H,W] unit normal and its concentration kappa > 0.
    """

    depth: Tensor
    confidence: Tensor
    normal: Tensor


class _Decoder(nn.Module):
    """Tokens to an estimate: fusion, a first guess, and a recurrent refinement."""

    def __init__(self, spec: Metric3dSpec) -> None:
        super().__init__()
        self.iterations = spec.iterations
        width = spec.maps[0]
        self.token2feature = TokensToMaps(spec.encoder.width, spec.encoder.prefix, spec.maps)
        self.decoder_mono = FeatureFusion((*spec.maps, spec.maps[2]))
        self.depth_regressor = nn.Sequential(
            Conv2d(width, 256, 3, padding=1), nn.ReLU(), Conv2d(256, 256, 1)
        )
        self.normal_predictor = nn.Sequential(
            Conv2d(width, 128, 3, padding=1), nn.ReLU(),
            Conv2d(128, 128, 1), nn.ReLU(),
            Conv2d(128, 128, 1), nn.ReLU(),
            Conv2d(128, 3, 1),
        )  # fmt: skip
        self.context_feature_encoder = ContextEncoder(spec.maps, spec.hidden)
        self.context_zqr_convs = nn.ModuleList(
            Conv2d(spec.hidden, 3 * spec.hidden, 3, padding=1) for _ in range(3)
        )
        self.update_block = UpdateBlock(spec.hidden, state=6)

    def first(self, fused: Tensor) -> Tensor:
        """State [B,6,a,b] from the fused map: depth, its confidence, normal, kappa."""
        features, confidence, kappa = fused[:, :-2], fused[:, -2:-1], fused[:, -1:]
        shares = self.depth_regressor(features).float().softmax(1)
        steps = torch.linspace(
            math.log(_NEAREST), math.log(_FARTHEST), shares.shape[1], device=shares.device
        )
        depth = (shares * steps.exp()[:, None, None]).sum(1, keepdim=True)
        depth = depth.clamp(_NEAREST, _FARTHEST)
        normal = self.normal_predictor(features).float()
        return torch.cat(
            [(depth - _SHIFT) / _SPREAD, confidence, _unit_normal(torch.cat([normal, kappa], 1))], 1
        )

    def context_inputs(self, maps: Maps) -> tuple[Tensor, Tensor, Tensor]:
        """The maps that the context is made of; the fusion has rectified two of them in place."""
        return maps[0], maps[1].relu(), maps[2].relu()

    def start(self, maps: Maps) -> tuple[list[Tensor], list[tuple[Tensor, ...]]]:
        """Hidden states and context of the gates z, r, q for the three scales."""
        hidden, context = [], []
        encoded = self.context_feature_encoder(self.context_inputs(maps))
        for (state, inputs), gates in zip(encoded, self.context_zqr_convs, strict=True):
            hidden.append(state.tanh())
            context.append(gates(inputs.relu()).chunk(3, 1))
        return hidden, context

    def weigh(self, hidden: list[Tensor]) -> Tensor:
        """Weights [B,144,a,b] of neighbours for the enlargement, before softmax, float32."""
        found: Tensor = self.update_block.mask(hidden[0])
        return 0.25 * found.float()

    def forward(self, tokens: Tensor, height: int, width: int) -> Estimate:
        """The estimate from tokens [B,prefix+gh*gw,D]."""
        maps = self.token2feature(tokens, height, width)
        state = self.first(self.decoder_mono(maps))
        hidden, context = self.start(maps)
        for _ in range(self.iterations):
            hidden, change = self.update_block(hidden, context, state)
            state = state + change
        return _read(_enlarge_convex(state, self.weigh(hidden)))


class Metric3d(nn.Module):
    """The whole network.

    Args:
        spec: sizes, an entry of `SIZES`.
    """

    def __init__(self, spec: Metric3dSpec) -> None:
        super().__init__()
        self.encoder = VisionTransformer(spec.encoder)
        self.decoder = _Decoder(spec)

    def forward(self, images: Tensor) -> Estimate:
        """Estimate for normalised pictures [B,3,H,W].

        Sides that are no multiples of 14 are enlarged to the next. The maps have the size of the
        picture where its sides are multiples of 28; of a side with an odd number g of patches,
        they have 4 * floor(3.5 g).
        """
        tokens, height, width = self.encode(images)
        found: Estimate = self.decoder(tokens, height, width)
        return found

    def encode(self, images: Tensor) -> tuple[Tensor, int, int]:
        """Tokens of normalised pictures [B,3,H,W] of any size, and the rows and columns."""
        height, width = (-(-side // PATCH) for side in images.shape[-2:])
        if images.shape[-2:] != (height * PATCH, width * PATCH):
            images = F.interpolate(
                images, size=(height * PATCH, width * PATCH), mode="bilinear", align_corners=False
            )
        return self.encoder(images), height, width


def _unit_normal(x: Tensor) -> Tensor:
    """Normals [B,4,a,b] of unit length with kappa above 0.01, from raw ones."""
    length = x[:, :3].norm(dim=1, keepdim=True) + 1e-10
    return torch.cat([x[:, :3] / length, F.elu(x[:, 3:]) + 1.01], 1)


def _enlarge_convex(state: Tensor, mask: Tensor) -> Tensor:
    """State [B,C,4a,4b]: every pixel is a mean of 3x3 cells [B,C,a,b], zeros outside.

    Args:
        mask: [B,144,a,b], neighbour before row before column.
    """
    batch, channels, height, width = state.shape
    shares = mask.view(batch, 9, 4, 4, height, width).softmax(1)
    cells = F.unfold(state, 3, padding=1).view(batch, channels, 9, height, width)
    found = torch.einsum("bnijhw,bcnhw->bchiwj", shares, cells)
    return found.reshape(batch, channels, 4 * height, 4 * width)


def _read(state: Tensor) -> Estimate:
    depth = (state[:, :1] * _SPREAD + _SHIFT).clamp(_NEAREST, _FARTHEST)
    return Estimate(depth, state[:, 1:2], _unit_normal(state[:, 2:]))


def published_shapes(variant: str) -> dict[str, tuple[int, ...]]:
    """Every key and shape of the published checkpoint, below `model_state_dict`."""
    spec = SIZES[variant]
    shapes = {}
    for key, shape in transformer_shapes(spec.encoder, "official").items():
        # One more level than in DINOv2, which is always 0.
        shapes[_ENCODER + key.replace("blocks.", "blocks.0.", 1)] = shape
    with torch.device("meta"):
        decoder = _Decoder(spec).state_dict()
    for key, value in decoder.items():
        shapes[_DECODER + key] = tuple(value.shape)
        if ".downsample.1." in key:  # stored a second time under another name
            shapes[_DECODER + key.replace(".downsample.1.", ".norm3.")] = tuple(value.shape)
    return shapes


def _check(variant: str, state: Mapping[str, Any]) -> dict[str, Tensor]:
    inner = state.get("model_state_dict")
    if isinstance(inner, Mapping):
        state = inner
    check_shapes(SIZES[variant].record, state, published_shapes(variant), (_UNUSED,))
    return floats(state)


def check_vit_small(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """Check a checkpoint strictly as that of the small network and return its tensors.

    Only `depth_model.encoder.mask_token`, which is never used, may be absent.

    Raises:
        InputError: what differs; see `droidw_plugins._vit.published.check_shapes`.
    """
    return _check("vit-small", state)


def check_vit_large(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """The same for the large network."""
    return _check("vit-large", state)


def load_metric3d(
    variant: str, state: Mapping[str, Any], device: torch.device, dtype: torch.dtype
) -> Metric3d:
    """The network with the weights of a published checkpoint.

    Args:
        variant: key of `SIZES`.
        state: as published, with or without `model_state_dict` around it.
        device, dtype: see `droidw_plugins._vit.layers.build`.
    Raises:
        InputError: the checkpoint is not that of this network; says what differs.
    """
    checked = _check(variant, state)
    encoder = {
        key.removeprefix(_ENCODER).replace("blocks.0.", "blocks.", 1): value
        for key, value in checked.items()
        if key.startswith(_ENCODER)
    }
    weights = {f"encoder.{key}": value for key, value in canonical(encoder).items()}
    for key, value in checked.items():
        # `norm3` is the second name of `downsample.1`, which counts where they differ.
        if key.startswith(_DECODER) and ".norm3." not in key:
            weights[f"decoder.{key.removeprefix(_DECODER)}"] = value
    with torch.device("meta"):
        network = Metric3d(SIZES[variant])
    return build(network, weights, device, dtype)
