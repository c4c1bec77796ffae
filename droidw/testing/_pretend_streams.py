"""Streams of the pretended GPU: everything runs at once, and what would be out of order is noted.

Every stream counts its operations, and knows of every other stream how far that is sure to be done
when its next operation starts: a clock for each pair. An operation may use a tensor if its stream
knows that the last write to that memory is done. Memory that dies goes back to the stream that it
was made on, which must then know that all other streams are done with it, unless `record_stream`
told the allocator of them.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

__all__ = ["PretendEvent", "PretendStream", "Streams"]

Clock = dict[int, int]


def _merge(into: Clock, other: Clock) -> None:
    for stream, tick in other.items():
        into[stream] = max(into.get(stream, 0), tick)


@dataclass
class _Memory:
    """Where memory was made, the last write, the last use by each stream, and who was recorded."""

    home: int
    writer: int
    tick: int
    uses: Clock = field(default_factory=dict)
    recorded: set[int] = field(default_factory=set)


class PretendStream:
    """Stands for `torch.cuda.Stream`."""

    def __init__(self, owner: Streams, number: int) -> None:
        self.owner, self.number = owner, number
        self.clock: Clock = {number: 0}
        self.cuda_stream = number

    def wait_stream(self, other: PretendStream) -> None:
        """Work from here on starts when all that `other` has now is done."""
        _merge(self.clock, other.clock)

    def wait_event(self, event: PretendEvent) -> None:
        """Work from here on starts when the event has happened."""
        _merge(self.clock, event.clock)

    def record_event(self, event: PretendEvent | None = None) -> PretendEvent:
        """An event after all that the stream has now."""
        event = event or PretendEvent(self.owner)
        event.record(self)
        return event

    def synchronize(self) -> None:
        """The host waits for the stream."""
        self.owner.waited("a stream", self.clock)


class PretendEvent:
    """Stands for `torch.cuda.Event`."""

    def __init__(self, owner: Streams) -> None:
        self.owner = owner
        self.clock: Clock = {}

    def record(self, stream: PretendStream | None = None) -> None:
        """Happen after all that the stream (the current one) has now."""
        self.clock = dict((stream or self.owner.current).clock)

    def wait(self, stream: PretendStream | None = None) -> None:
        """Let the stream (the current one) wait for this."""
        (stream or self.owner.current).wait_event(self)

    def query(self) -> bool:
        """Whether it has happened: a GPU is quick here."""
        return True

    def synchronize(self) -> None:
        """The host waits for it."""
        self.owner.waited("an event", self.clock)

    def elapsed_time(self, other: PretendEvent) -> float:
        """Milliseconds: none."""
        return 0.0


class Streams:
    """All streams, and what was found out of order.

    Attributes:
        faults: sentences.
        used_by: operations by number of the stream; 0 is the one that is there from the start.
    """

    def __init__(self, waited: Callable[[str], None]) -> None:
        self.faults: list[str] = []
        self.default = PretendStream(self, 0)
        self._all = [self.default]
        self._host: Clock = {}
        self._memory: dict[int, _Memory] = {}
        self._local = threading.local()
        self._lock = threading.RLock()
        self._waited = waited

    def make(self, device: Any = None, priority: int = 0) -> PretendStream:
        """A new stream."""
        with self._lock:
            stream = PretendStream(self, len(self._all))
            self._all.append(stream)
        return stream

    def event(self, *args: Any, **kwargs: Any) -> PretendEvent:
        """A new event."""
        return PretendEvent(self)

    @property
    def current(self) -> PretendStream:
        """The stream of this thread."""
        found: PretendStream = getattr(self._local, "stream", self.default)
        return found

    @contextmanager
    def on(self, stream: PretendStream | None) -> Iterator[None]:
        """Work of this thread goes to `stream`."""
        before = self.current
        self._local.stream = stream or before
        try:
            yield
        finally:
            self._local.stream = before

    @property
    def used_by(self) -> dict[int, int]:
        """Operations of each stream."""
        return {stream.number: stream.clock[stream.number] for stream in self._all}

    def waited(self, what: str, clock: Clock) -> None:
        """The host waits for a stream or an event; what it starts later comes after that."""
        with self._lock:
            _merge(self._host, clock)
        self._waited(what)

    def host_waits(self) -> None:
        """The host waits for all that the current stream has."""
        with self._lock:
            _merge(self._host, self.current.clock)

    def used(self, tensors: list[Tensor]) -> None:
        """The current stream starts an operation that reads these."""
        with self._lock:
            now = self.current
            _merge(now.clock, self._host)
            now.clock[now.number] += 1
            for tensor in tensors:
                memory = self._of(tensor)
                if now.clock.get(memory.writer, 0) < memory.tick:
                    self._fault(
                        f"stream {now.number} uses a tensor {tuple(tensor.shape)} that stream "
                        f"{memory.writer} may not have finished"
                    )
                memory.uses[now.number] = now.clock[now.number]

    def written(self, tensors: list[Tensor], changed: bool) -> None:
        """The current stream has made these, or changed them."""
        with self._lock:
            now = self.current
            for tensor in tensors:
                memory = self._of(tensor)
                if memory.tick == 0 or changed:
                    memory.writer, memory.tick = now.number, now.clock[now.number]

    def record_stream(self, tensor: Any, stream: PretendStream) -> None:
        """Tell the allocator that `stream` uses the tensor."""
        with self._lock:
            self._of(tensor.numbers).recorded.add(stream.number)

    def _of(self, tensor: Tensor) -> _Memory:
        storage = tensor.untyped_storage()
        key = storage._cdata
        found = self._memory.get(key)
        if found is None:
            found = self._memory[key] = _Memory(self.current.number, self.current.number, 0)
            weakref.finalize(storage, self._gone, key)
        return found

    def _gone(self, key: int) -> None:
        """Memory goes back to the stream that it was made on."""
        with self._lock:
            memory = self._memory.pop(key, None)
            if memory is None:
                return
            home = self._all[memory.home]
            for stream, tick in memory.uses.items():
                known = max(home.clock.get(stream, 0), self._host.get(stream, 0))
                if stream != memory.home and stream not in memory.recorded and known < tick:
                    self._fault(
                        f"memory of stream {memory.home} was given up while stream {stream} may "
                        "still use it: record_stream is missing"
                    )

    def _fault(self, text: str) -> None:
        if text not in self.faults:
            self.faults.append(text)
