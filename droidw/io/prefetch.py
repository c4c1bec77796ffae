"""Working ahead in a thread of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar, cast

T = TypeVar("T")

__all__ = ["prefetch"]


def prefetch(
    items: Iterable[T], ahead: int = 4, stop: Callable[[], None] = lambda: None
) -> Generator[T, None, None]:
    """Yield `items` in order while a thread prepares up to `ahead` more.

    What the source raises is raised here, at its place in the order. When the generator is
    closed or dropped, the thread ends and the source, if it is a generator, is closed.

    Args:
        items: prepared one after the other.
        ahead: 0: each is prepared when it is asked for, without a thread.
        stop: called when no more items are wanted, so that a source that waits for what is made
            of its items waits no longer.
    """
    if ahead <= 0:
        yield from items
        return
    source = iter(items)
    end = object()
    worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="droidw-prefetch")
    waiting: deque[Future[object]] = deque()
    try:
        for _ in range(ahead):
            waiting.append(worker.submit(next, source, end))
        while True:
            item = waiting.popleft().result()
            if item is end:
                return
            waiting.append(worker.submit(next, source, end))
            yield cast("T", item)
    finally:
        stop()
        worker.shutdown(wait=True, cancel_futures=True)
        if isinstance(source, Generator):
            source.close()
