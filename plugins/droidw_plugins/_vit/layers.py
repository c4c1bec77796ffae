"""Layers and settings shared by the paper's networks: precision, and exact float32 on a GPU.

Products of matrices and convolutions may be computed in half precision; sums along the residual
stream, normalisations and softmax over depths stay in float32. That is what the published system
does under CUDA's mixed precision, without casting the weights again at each call.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Literal, TypeVar

import torch
from torch import Tensor, nn

from droidw.errors import ConfigError

__all__ = ["Conv2d", "Linear", "Precision", "build", "choose_dtype", "exact"]

Precision = Literal["auto", "float32", "bfloat16", "float16"]
"""Precision of matrix products; "auto": float16 on a GPU, as published, else float32."""

Network = TypeVar("Network", bound=nn.Module)


class Linear(nn.Linear):
    """A linear layer that takes any float type and computes in that of its weights."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.to(self.weight.dtype))


class Conv2d(nn.Conv2d):
    """A convolution that takes any float type and computes in that of its weights."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.to(self.weight.dtype))


def choose_dtype(precision: Precision, device: torch.device, key: str) -> torch.dtype:
    """The type in which matrix products are computed.

    Args:
        precision: as in the options.
        device: of the run.
        key: full name of the option, for the message.
    Raises:
        ConfigError: float16 on a CPU, where it is slow and not made for this.
    """
    if precision == "auto":
        return torch.float16 if device.type == "cuda" else torch.float32
    if precision == "float16" and device.type != "cuda":
        raise ConfigError(
            f"{key}: float16 needs a GPU, and this run is on {device.type}",
            f"valid on a CPU: {key}=float32 or {key}=bfloat16",
        )
    chosen: torch.dtype = getattr(torch, precision)
    return chosen


def build(
    network: Network, state: Mapping[str, Tensor], device: torch.device, dtype: torch.dtype
) -> Network:
    """Give a network made on the device "meta" its weights and make it ready for inference.

    Args:
        network: its parameters have no storage, and are replaced.
        state: a tensor for every parameter, by key; taken over without a copy where it fits.
        device: where the network is to live.
        dtype: of the weights of matrix products and convolutions; the rest is float32.
    """
    network.load_state_dict(
        {key: value.detach().to(torch.float32) for key, value in state.items()},
        strict=True,
        assign=True,
    )
    network.requires_grad_(False).eval()
    for module in network.modules():
        if isinstance(module, (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)):
            module.to(dtype)
    return network.to(device)


@contextmanager
def exact(dtype: torch.dtype, device: torch.device) -> Iterator[None]:
    """Inside, convolutions in float32 on a GPU are float32: cuDNN rounds to TF32 by default."""
    if device.type != "cuda" or dtype != torch.float32:
        yield
        return
    cudnn = torch.backends.cudnn
    with cudnn.flags(
        enabled=cudnn.enabled,
        benchmark=cudnn.benchmark,
        deterministic=cudnn.deterministic,
        allow_tf32=False,
    ):
        yield
