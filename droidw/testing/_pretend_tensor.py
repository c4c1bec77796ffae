"""A tensor that says it is on a GPU, and computes on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

if TYPE_CHECKING:
    from droidw.testing.pretend_gpu import PretendGpu

__all__ = ["GPU", "PretendTensor", "each_tensor"]

GPU = torch.device("cuda", 0)
"""The device that is pretended."""


class PretendTensor(Tensor):
    """A tensor that says it is on the GPU.

    Attributes:
        numbers: what it holds, on the CPU.
        gpu: the pretended GPU that there is at the moment.
    """

    numbers: Tensor
    gpu: ClassVar[PretendGpu | None] = None

    @staticmethod
    def __new__(cls: Any, numbers: Tensor) -> PretendTensor:
        shape = torch.empty_strided(
            numbers.shape, numbers.stride(), dtype=numbers.dtype, device="meta", requires_grad=False
        )
        # Dispatched as on a GPU, but on "meta", since torch would ask a driver about "cuda".
        made: PretendTensor = torch.Tensor._make_subclass(
            cls, shape, False, device_for_backend_keys=GPU
        )
        made.numbers = numbers
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        if cls.gpu is None:
            raise RuntimeError("a tensor of a pretended GPU outlived it")
        return cls.gpu.compute(func, args, kwargs or {})

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        """`GPU`."""
        return GPU

    @property
    def is_cuda(self) -> bool:  # type: ignore[override]
        """True."""
        return True

    @property
    def is_meta(self) -> bool:  # type: ignore[override]
        """False."""
        return False

    def __tensor_flatten__(self) -> tuple[list[str], None]:
        return ["numbers"], None

    @staticmethod
    def __tensor_unflatten__(parts: Any, meta: Any, size: Any, stride: Any) -> PretendTensor:
        return PretendTensor(parts["numbers"])

    def tolist(self) -> Any:
        """As of torch: one copy to the host."""
        return self.cpu().tolist()

    def numpy(self, *, force: bool = False) -> Any:
        """Refused, as by torch."""
        raise TypeError(
            "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the "
            "tensor to host memory first."
        )

    def data_ptr(self) -> int:
        """Refused: there is no memory of a GPU."""
        raise RuntimeError("a pretended tensor has no address: kernels cannot be called with it")

    def new_tensor(self, data: Any, dtype: Any = None, device: Any = None) -> Tensor:  # type: ignore[override]
        """As of torch: made on the host and copied."""
        return torch.tensor(data, dtype=dtype or self.dtype, device=device or GPU)

    def __getitem__(self, index: Any) -> Tensor:
        return super().__getitem__(_without_lists(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        if isinstance(value, (bool, int, float)):
            # torch, too, makes the number a tensor of the host here
            value = torch.tensor(value, dtype=self.dtype)
        super().__setitem__(_without_lists(index), value)

    def __repr__(self, *, tensor_contents: Any = None) -> str:  # type: ignore[override]
        return f"PretendTensor({self.numbers!r})"

    def __format__(self, spec: str) -> str:
        return format(self.item(), spec) if self.dim() == 0 else repr(self)


def each_tensor(change: Callable[[Tensor], Any], values: Any) -> Any:
    """Arguments or results of an operation with `change` made of every tensor in them."""
    if isinstance(values, Tensor):
        return change(values)
    if isinstance(values, (list, tuple)):
        return type(values)([each_tensor(change, v) for v in values])
    if isinstance(values, dict):
        return {k: each_tensor(change, v) for k, v in values.items()}
    return values


def _without_lists(index: Any) -> Any:
    """An index with lists as tensors of the host, as torch makes them."""
    if isinstance(index, list):
        return torch.tensor(index)
    if isinstance(index, tuple):
        return tuple(torch.tensor(i) if isinstance(i, list) else i for i in index)
    return index
