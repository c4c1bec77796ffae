"""Wall time by stage, for the manifest and the benchmark.

On a GPU this is the time of the host: work that it only starts is cheap, and the stage in which it
waits for a result pays for all of it. To wait at each stage would cost more than it tells; with
CUDA_LAUNCH_BLOCKING=1 in the environment every stage pays for its own.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["Stopwatch"]


class Stopwatch:
    """Adds up seconds under names; nested stages each count their own."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time the body of a `with` block under `name`."""
        started = time.perf_counter()
        try:
            yield
        finally:
            taken = time.perf_counter() - started
            self.seconds[name] = self.seconds.get(name, 0.0) + taken
