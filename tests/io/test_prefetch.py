"""Working ahead: order, bounds, exceptions carried over, and threads that end."""

from __future__ import annotations

import threading

import pytest

from droidw.errors import InputError
from droidw.io.prefetch import prefetch


def threads():
    return [t for t in threading.enumerate() if t.name.startswith("droidw-prefetch")]


def test_everything_arrives_in_order_and_the_thread_ends():
    assert list(prefetch(iter(range(100)), ahead=3)) == list(range(100))
    assert list(prefetch([], ahead=3)) == []
    assert threads() == []


def test_at_most_so_many_are_prepared_ahead():
    made = []

    def source():
        for i in range(100):
            made.append(i)
            yield i

    ahead = prefetch(source(), ahead=4)
    for _ in range(5):
        next(ahead)
    assert len(made) <= 5 + 4
    ahead.close()


def test_an_exception_comes_at_its_place():
    def source():
        yield 1
        yield 2
        raise InputError("the disk is on fire")

    ahead = prefetch(source())
    assert [next(ahead), next(ahead)] == [1, 2]
    with pytest.raises(InputError, match="on fire"):
        next(ahead)
    assert threads() == []


def test_closing_early_ends_the_thread_and_closes_the_source():
    closed = []

    def source():
        try:
            yield from range(1000)
        finally:
            closed.append(True)

    ahead = prefetch(source())
    assert next(ahead) == 0
    assert len(threads()) == 1
    ahead.close()
    assert threads() == []
    assert closed == [True]


def test_none_is_an_item_like_any_other():
    assert list(prefetch([None, 1, None])) == [None, 1, None]


def test_nothing_ahead_needs_no_thread():
    ahead = prefetch(range(3), ahead=0)
    assert next(ahead) == 0
    assert threads() == []
    assert list(ahead) == [1, 2]


def test_a_source_that_waits_for_its_items_is_told_to_stop():
    told = threading.Event()

    def source():
        yield 1
        assert told.wait(10)
        yield 2

    ahead = prefetch(source(), stop=told.set)
    assert next(ahead) == 1
    ahead.close()
    assert told.is_set()
    assert threads() == []
