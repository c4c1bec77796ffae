"""A pretended GPU: real numbers on the CPU, the rules of another device, and every wait counted.

What goes wrong on a GPU is seldom a number. It is a tensor that was made on the wrong device, a
line for which the host waits until the device has done all its work, or a stream that reads what
another has not finished. Inside `PretendGpu` the device "cuda" is there: a tensor on it is computed
on the CPU, refuses to meet a tensor of the host where torch would refuse, each wait of the host is
counted by the line that made it, and work on streams is checked to be in order. Kernels behind raw
pointers cannot be pretended, nor can the limits of memory and the speed of anything.
"""

from __future__ import annotations

import sys
import threading
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from droidw.testing._pretend_streams import Streams
from droidw.testing._pretend_tensor import GPU, PretendTensor, each_tensor
from droidw.testing._pretend_torch import Autocast, cuda_module, stand_ins

__all__ = ["GPU", "PretendGpu", "PretendTensor"]

_WAITS = {
    "_local_scalar_dense", "_linalg_check_errors", "_linalg_eigh", "_linalg_svd", "_unique2",
    "bincount", "equal", "histc", "linalg_eig", "masked_select", "nonzero", "unique_consecutive",
    "unique_dim",
}  # fmt: skip
"""Operations whose answer the host reads before it goes on."""

_STRICT = {
    "addmm", "baddbmm", "bmm", "cat", "convolution", "dot", "gather", "grid_sampler_2d",
    "index_add", "index_add_", "index_copy", "index_copy_", "index_select", "mm", "mv", "scatter",
    "scatter_", "scatter_add", "scatter_add_", "scatter_reduce", "scatter_reduce_", "searchsorted",
    "stack", "take",
}  # fmt: skip
"""Operations that take no tensor of the host, not even a single number, beside those of the GPU."""

_HALVED = {"addmm", "addmv", "baddbmm", "bmm", "convolution", "mm", "mv"}
"""Operations that autocast computes in half precision."""

_INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"}


class PretendGpu:
    """Inside `with PretendGpu() as gpu:` there is a GPU, in all threads that are started there.

    Attributes:
        waits: (what for, file:line) -> how often the host waited for the GPU. A copy to the GPU is
            a wait unless its source is pinned and it may be late, as in torch.
        streams: work by stream, and what was found out of order.
    """

    def __init__(self) -> None:
        self.waits: Counter[tuple[str, str]] = Counter()
        self.streams = Streams(self._waited)
        self._by_thread: Counter[int] = Counter()
        self._autocast = Autocast()
        self._lock = threading.RLock()
        self._stack = ExitStack()

    def __enter__(self) -> PretendGpu:
        if PretendTensor.gpu is not None:
            raise RuntimeError("one pretended GPU at a time")
        enter = self._stack.enter_context
        enter(mock.patch.object(PretendTensor, "gpu", self))
        stand_ins(self.streams, self._stack)
        for patch in cuda_module(self.streams, lambda: self._waited("synchronize")):
            enter(patch)
        for patch in self._autocast.patches():
            enter(patch)
        run, gpu = threading.Thread.run, self

        def run_with_gpu(thread: threading.Thread) -> None:
            with _Mode(gpu):
                run(thread)

        enter(mock.patch.object(threading.Thread, "run", run_with_gpu))
        enter(_Mode(self))
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def waits_by_line(self) -> str:
        """All waits, the most frequent first, one a line."""
        return "\n".join(f"{n:6d} {what}: {at}" for (what, at), n in self.waits.most_common())

    def total(self) -> int:
        """How often this thread has waited so far."""
        return self._by_thread[threading.get_ident()]

    # -- operations ------------------------------------------------------------------------

    def compute(self, func: Any, args: Any, kwargs: Any) -> Any:
        """One operation of torch: rules and waits, then the numbers on the CPU."""
        name = func.overloadpacket.__name__
        there: list[PretendTensor] = []
        here: list[Tensor] = []

        def unwrap(tensor: Tensor) -> Tensor:
            if isinstance(tensor, PretendTensor):
                there.append(tensor)
                return tensor.numbers
            here.append(tensor)
            return tensor

        asked = kwargs.get("device")
        plain = each_tensor(unwrap, args)
        named = each_tensor(unwrap, {k: v for k, v in kwargs.items() if k != "device"})
        if not there and (asked is None or asked.type != "cuda"):
            return func(*args, **kwargs)
        if any(tensor.is_meta for tensor in here):
            raise RuntimeError(f"{name} meets a tensor without numbers; this is not pretended")
        if asked is not None:
            named["device"] = torch.device("cpu")
        to_gpu = self._obey(name, args, named, asked, here)
        if name in _HALVED:
            plain = self._autocast.cast(plain)
        self.streams.used([t.numbers for t in there])
        out = func(*plain, **named)
        if not to_gpu:
            return args[0] if name == "copy_" else out
        known = {id(t.numbers): t for t in there}
        made: list[Tensor] = []

        def wrap(tensor: Tensor) -> Tensor:
            made.append(tensor)
            wrapper = known.get(id(tensor))
            if wrapper is None:
                return PretendTensor(tensor)
            if wrapper.shape != tensor.shape:  # an operation such as squeeze_
                with torch._C._DisableTorchDispatch():
                    func(*args, **kwargs)
            return wrapper

        wrapped = each_tensor(wrap, out)
        self.streams.written(made, changed=func._schema.is_mutable)
        return wrapped

    def _obey(self, name: str, args: Any, named: Any, asked: Any, here: list[Tensor]) -> bool:
        """Rules of two devices, and waits; returns whether the result is on the GPU."""
        if name == "copy_":
            to_gpu = isinstance(args[0], PretendTensor)
            late = bool(args[2]) if len(args) > 2 else bool(named.get("non_blocking", False))
            if here:
                self._copied(here, to_gpu, late)
            return to_gpu
        to_gpu = asked is None or asked.type != "cpu"
        if name == "_to_copy":
            self._copied(here, to_gpu, bool(named.pop("non_blocking", False)))
        elif name in _INDEXING:
            self._indexed(name, args)
        elif any(tensor.dim() > 0 or name in _STRICT for tensor in here):
            raise _refusal(name)
        if name in _WAITS or (name == "repeat_interleave" and not named.get("output_size")):
            self._waited(name)
        return to_gpu

    def _indexed(self, name: str, args: Any) -> None:
        indices = [i for i in args[1] if i is not None]
        masks = [i for i in indices if i.dtype == torch.bool]
        value: Any = args[2] if name not in ("index", "_unsafe_index") else None
        foreign = value is not None and not isinstance(value, PretendTensor)
        if foreign and value.dim() > 0:
            raise _refusal(name)
        if any(not isinstance(i, PretendTensor) for i in indices):
            self._waited("an index of the host is copied")
        if foreign and len(indices) == len(masks) == 1:
            return  # a number where a mask is true: filled without asking how many
        if masks:
            self._waited("the number of cells of a mask is read")
        if foreign:
            self._waited("a number is copied")

    def _copied(self, sources: list[Tensor], to_gpu: bool, late: bool) -> None:
        if not to_gpu and late:
            raise RuntimeError("a copy to the host that does not block may be read too early")
        if not to_gpu:
            self._waited("a copy to the host")
        elif sources and not (late and all(t.is_pinned() for t in sources)):
            self._waited("a copy from the host" + ", not pinned" * late)

    def _waited(self, what: str) -> None:
        with self._lock:
            self.waits[what, _caller()] += 1
            self._by_thread[threading.get_ident()] += 1
        self.streams.host_waits()


class _Mode(TorchDispatchMode):
    """Sends operations that make tensors out of nothing, or of the host, to the pretended GPU."""

    def __init__(self, gpu: PretendGpu) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._gpu = gpu

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self._gpu.compute(func, args, kwargs or {})


def _refusal(name: str) -> RuntimeError:
    return RuntimeError(
        "Expected all tensors to be on the same device, but found at least two devices, cuda:0 "
        f"and cpu! (in {name})"
    )


_ROOMS = tuple(
    f"{Path(__file__).resolve().parents[2] / room}/"
    for room in ("droidw", "plugins/droidw_plugins")
)


def _caller() -> str:
    """The line of the project that led here, as file:line."""
    frame: Any = sys._getframe(1)
    while frame is not None:
        file = frame.f_code.co_filename
        name = file.rpartition("/")[2]
        ours = file.startswith(_ROOMS) and not name.startswith(("pretend_", "_pretend_"))
        if ours:
            return f"{name}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"
