"""Small tensors of the host brought to where the run computes, without waiting for a GPU.

`torch.tensor(values, device=...)` and `Tensor.to(device)` wait until the GPU has done all that it
was given before, since their source may be changed or freed at once. From pinned memory a copy
takes its turn, and the host goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["on_device", "upload"]

Numbers = Sequence[float] | Sequence[int] | Sequence[Sequence[float]]


def on_device(
    values: Numbers, device: torch.device | str, dtype: torch.dtype = torch.int64
) -> Tensor:
    """A tensor of these numbers on a device; on a CPU what `torch.tensor` gives.

    Args:
        values: numbers of the host, nested as for `torch.tensor`.
        device: where the tensor is wanted.
        dtype: of the result.
    """
    return upload(torch.tensor(values, dtype=dtype), device)


def upload(tensor: Tensor, device: torch.device | str) -> Tensor:
    """The tensor on a device; where that is not a GPU, or it is there already, as `Tensor.to`."""
    device = torch.device(device)
    if device.type != "cuda" or tensor.is_cuda:
        return tensor.to(device)
    pinned = tensor if tensor.is_pinned() else tensor.pin_memory()
    return pinned.to(device, non_blocking=True)
