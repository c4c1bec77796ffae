"""The DROID network as one module, with the keys of the published state dict (REFERENCE 1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from droidw_plugins.correspondence._droid_encoder import Encoder, normalise
from droidw_plugins.correspondence._droid_state import check_state
from droidw_plugins.correspondence._droid_update import UpdateOperator

__all__ = ["DroidNet", "motion_features", "upsample_convex"]

_MOST_MOTION = 64.0


class DroidNet(nn.Module):
    """Feature encoder `fnet`, context encoder `cnet` and `update` operator.

    Make one with `from_state`. It does not draw random numbers and needs no gradients.
    """

    def __init__(self) -> None:
        super().__init__()
        self.fnet = Encoder(128, norm=True)
        self.cnet = Encoder(256, norm=False)
        self.update = UpdateOperator()

    @classmethod
    def from_state(
        cls, state: Mapping[str, Tensor], device: torch.device | str = "cpu"
    ) -> DroidNet:
        """The network with these weights (as `check_state` takes them), in float32.

        Raises:
            InputError: as `check_state`.
        """
        tensors = {}
        for key, value in check_state(state).items():
            tensor = value.detach().to(device=device, dtype=torch.float32)
            last = torch.channels_last if tensor.dim() == 4 else torch.contiguous_format
            tensors[key] = tensor.contiguous(memory_format=last)
        with torch.device("meta"):
            net = cls()
        net.load_state_dict(tensors, strict=True, assign=True)
        net.requires_grad_(False).eval()
        net.update.fuse()
        return net

    def features(self, images: Tensor) -> Tensor:
        """Features [B,128,h,w] of RGB pictures [B,3,H,W] in [0,1]."""
        features: Tensor = self.fnet(normalise(images))
        return features

    def context(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Initial hidden state and context, each [B,128,h,w], of RGB pictures [B,3,H,W]."""
        net, inp = self.cnet(normalise(images)).chunk(2, dim=1)
        return torch.tanh(net), torch.relu(inp)


def motion_features(coords: Tensor, target: Tensor, grid: Tensor) -> Tensor:
    """What the update operator hears of the motion so far, [E,4,h,w], clamped to 64 cells.

    Args:
        coords: [E,h,w,2] current reprojection. target: [E,h,w,2] what was measured last.
        grid: [h,w,2] the cells themselves.
    """
    both = torch.cat([coords - grid, target - coords], dim=-1)
    return both.clamp(-_MOST_MOTION, _MOST_MOTION).permute(0, 3, 1, 2)


def upsample_convex(
    disps: Tensor, mask: Tensor, border: Literal["replicate", "zeros"] = "replicate"
) -> Tensor:
    """Maps at 8 times the size, each value a convex mix of the 3x3 around it (REFERENCE 1.5).

    Args:
        disps: [U,h,w]. mask: [U,576,h,w], channel 64 k + 8 sy + sx, before the softmax over k.
        border: what lies around the map: its own border, or zeros as published, which pulls the
            outermost values towards 0.
    Returns:
        [U,8h,8w] float32; values are inverse depths and are not scaled.
    """
    count, height, width = disps.shape
    share = torch.softmax(mask.float().view(count, 9, 8, 8, height, width), dim=1)
    mode = "replicate" if border == "replicate" else "constant"
    around = F.pad(disps.float()[:, None], (1, 1, 1, 1), mode=mode)
    near = F.unfold(around, 3).view(count, 9, 1, 1, height, width)
    fine = (share * near).sum(dim=1)
    return fine.permute(0, 3, 1, 4, 2).reshape(count, 8 * height, 8 * width)
