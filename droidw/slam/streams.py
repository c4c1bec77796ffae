"""A stream of its own for work on frames to come, so that a GPU does it beside tracking.

A thread looks ahead: it encodes frames, judges them, and makes features and depth of those that
become keyframes. On a GPU its work would queue up behind that of tracking, and tracking behind it,
as long as both go to one stream. Here they do not, and an event for each frame puts in order what
must be. On a CPU, and where nothing looks ahead, all of this does nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

__all__ = ["Ahead", "nbytes", "tensors_in"]


class Ahead:
    """The stream of the thread that looks ahead, and the way over to tracking.

    Made when all networks are where they belong: the stream starts after what made them.

    Args:
        device: of the run.
        threaded: whether a thread looks ahead at all.
    Attributes:
        stream: a `torch.cuda.Stream`, or None where nothing is to be done.
    """

    def __init__(self, device: torch.device, threaded: bool) -> None:
        self._device = device
        self.stream: Any = None
        if threaded and device.type == "cuda":
            self.stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
            self.stream.wait_stream(torch.cuda.current_stream(device))

    @contextmanager
    def working(self) -> Iterator[None]:
        """Inside, what this thread gives to the GPU goes to the stream."""
        if self.stream is None:
            yield
            return
        with torch.cuda.stream(self.stream):
            yield

    def ready(self) -> Any:
        """An event after all that the stream has been given, for `take`; None without a stream."""
        return None if self.stream is None else self.stream.record_event()

    def take(self, ready: Any, *made: Any) -> None:
        """Let this thread's stream go on when `ready` has happened, and use what was made.

        The host waits for nothing.

        Args:
            ready: of `ready`.
            made: tensors, or what holds them (dataclasses, lists, dicts). Their memory is not
                given to others before the stream of this thread is done with it.
        """
        if ready is None:
            return
        current = torch.cuda.current_stream(self._device)
        current.wait_event(ready)
        for tensor in tensors_in(made):
            if tensor.is_cuda:
                tensor.record_stream(current)


def tensors_in(value: Any) -> Iterator[Tensor]:
    """All tensors that a value is or holds, in dataclasses, lists, tuples and dicts."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from tensors_in(item)
    elif isinstance(value, dict):
        yield from tensors_in(list(value.values()))
    elif is_dataclass(value) and not isinstance(value, type):
        for entry in fields(value):
            yield from tensors_in(getattr(value, entry.name))


def nbytes(payload: object) -> int:
    """Bytes of the arrays and tensors that a payload is or holds directly."""
    if isinstance(payload, (list, tuple)):
        values: Iterable[object] = payload
    else:
        values = (payload, *getattr(payload, "__dict__", {}).values())
    return sum(int(getattr(value, "nbytes", 0)) for value in values)
