"""What torch itself must do differently where a GPU is pretended: it would ask a driver."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, nullcontext
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.testing._pretend_streams import Streams
from droidw.testing._pretend_tensor import GPU, PretendTensor, each_tensor

__all__ = ["Autocast", "cuda_module", "stand_ins"]

_FLOATS = (torch.float32, torch.float16, torch.bfloat16)


class Autocast:
    """The precision that `torch.autocast("cuda")` asks for, thread by thread.

    torch applies it only to tensors of a true GPU.
    """

    def __init__(self) -> None:
        self._local = threading.local()

    @property
    def dtype(self) -> torch.dtype | None:
        """Half precision, or None where nothing is cast."""
        stack = self._stack()
        return stack[-1] if stack else None

    def cast(self, values: Any) -> Any:
        """Arguments of an operation that autocast computes in half precision."""
        dtype = self.dtype
        if dtype is None:
            return values
        return each_tensor(lambda t: t.to(dtype) if t.dtype in _FLOATS else t, values)

    def _stack(self) -> list[torch.dtype | None]:
        found: list[torch.dtype | None] = self._local.__dict__.setdefault("stack", [])
        return found

    def patches(self) -> Iterator[Any]:
        """Keep count of the contexts, and cast for convolutions, whose types torch compares."""
        autocast: Any = torch.autocast
        enter, leave = autocast.__enter__, autocast.__exit__

        def entered(context: Any) -> Any:
            on = context._enabled and context.device == "cuda"
            self._stack().append(context.fast_dtype if on else None)
            return enter(context)

        def left(context: Any, *exc: Any) -> Any:
            self._stack().pop()
            return leave(context, *exc)

        yield mock.patch.object(torch.autocast, "__enter__", entered)
        yield mock.patch.object(torch.autocast, "__exit__", left)
        for name in ("conv2d", "conv_transpose2d"):
            yield mock.patch.object(F, name, self._convolution(getattr(F, name)))

    def _convolution(self, convolve: Callable[..., Any]) -> Callable[..., Any]:
        def convolved(*args: Any, **kwargs: Any) -> Any:
            if isinstance(args[0], PretendTensor):
                args, kwargs = self.cast((args, kwargs))
            return convolve(*args, **kwargs)

        return convolved


def stand_ins(streams: Streams, stack: ExitStack) -> None:
    """Replace, until the stack is closed, functions of torch that would ask a driver."""
    pinned: dict[int, Tensor] = {}  # they are kept, so that no other gets the same id

    def pin(tensor: Tensor, device: Any = None) -> Tensor:
        copy = tensor.clone()
        pinned[id(copy)] = copy
        return copy

    patches: list[Any] = [
        mock.patch.object(torch, "tensor", _made_here(torch.tensor)),
        mock.patch.object(torch, "as_tensor", _made_here(torch.as_tensor)),
        mock.patch.object(torch, "where", _chosen(torch.where)),
        mock.patch.object(Tensor, "to", _numbered(Tensor.to)),
        mock.patch.object(Tensor, "pin_memory", pin),
        mock.patch.object(Tensor, "is_pinned", lambda t, device=None: id(t) in pinned),
        mock.patch.object(Tensor, "record_stream", lambda t, s: streams.record_stream(t, s)),
    ]
    for patch in patches:
        stack.enter_context(patch)


def cuda_module(streams: Streams, synchronize: Callable[[], None]) -> Iterator[Any]:
    """Patches of the module `torch.cuda`."""
    replaced: dict[str, Any] = {
        "_lazy_init": lambda: None,
        "is_available": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "get_device_name": lambda device=None: "a pretended GPU",
        "get_device_capability": lambda device=None: (8, 0),
        "device": lambda device=None: nullcontext(),
        "synchronize": lambda device=None: synchronize(),
        "max_memory_allocated": lambda device=None: 0,
        "Stream": streams.make,
        "Event": streams.event,
        "stream": streams.on,
        "current_stream": lambda device=None: streams.current,
    }
    for name, value in replaced.items():
        yield mock.patch.object(torch.cuda, name, value)


def _made_here(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """`torch.tensor`: made on the host, then copied, as torch does behind a guard."""

    def made(data: Any, *args: Any, device: Any = None, **kwargs: Any) -> Tensor:
        if isinstance(data, PretendTensor):
            return data if device is None else data.to(device)
        tensor = make(data, *args, **kwargs)
        return tensor if device is None else tensor.to(device)

    return made


def _chosen(where: Callable[..., Any]) -> Callable[..., Any]:
    """`torch.where`, which would make a number a tensor on the device "meta", and so lose it."""

    def chosen(condition: Tensor, *values: Any, **kwargs: Any) -> Any:
        tensors = [v if isinstance(v, Tensor) else torch.tensor(v) for v in values]
        return where(condition, *tensors, **kwargs)

    return chosen


def _numbered(to: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """`Tensor.to`, with the number of the device, which torch would ask a driver for."""

    def moved(tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        wanted = [_with_number(a) for a in args]
        named = {k: _with_number(v) if k == "device" else v for k, v in kwargs.items()}
        if isinstance(tensor, PretendTensor):
            # It is there already; torch would compare with the device "meta", and copy.
            wanted = [a for a in wanted if a != GPU]
            named = {k: v for k, v in named.items() if v != GPU}
            changes = [a for a in wanted if not isinstance(a, bool)]
            if not changes and not named.get("dtype") and "device" not in named:
                return tensor
        return to(tensor, *wanted, **named)

    return moved


def _with_number(device: Any) -> Any:
    """A device "cuda" with its number; anything else as it is."""
    if isinstance(device, (str, torch.device)) and str(device).startswith("cuda"):
        return GPU
    return device
