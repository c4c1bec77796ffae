"""Searches between whole pictures are kept while what is taken out of them changes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.interfaces.correspondence import EdgeRequest
from droidw_plugins.correspondence._flow_mask import bridge
from droidw_plugins.correspondence._flow_types import Kept, KeptInRounds

H, W = 120, 160


@pytest.fixture
def pair(frame):
    """`pair(part)`: two encoded pictures, the second moved by 5 pixels."""

    def call(part):
        y, x = np.mgrid[:H, :W].astype(np.float32)
        grid = Grid.of(H, W, part.stride, part.offset)

        def moved(by):
            waves = np.sin((x - by) / 5 + y / 9) + np.sin((x - by) / 11 - y / 6)
            return (128 + 40 * waves).astype(np.float32)

        return [part.encode(frame(k, moved(5 * k)), grid) for k in range(2)]

    return call


def closing(frames, columns):
    """A gate that is closed over the first columns."""
    gate = np.ones(frames[0].normal.shape[:2], np.float32)
    gate[:, :columns] = 0.0
    return gate


def ask(part, frames, columns, start=None):
    """Both edges where uncertainty closes the first columns of both pictures."""
    return ask_by(part, frames, closing(frames, columns), start)


def ask_by(part, frames, gate, start=None):
    """Both edges by this gate of both pictures."""
    without = tuple(bridge(f, gate, 0.5, 7, part.options.blur) for f in frames)
    return part.both_ways(*frames, start, start, fine=True, bridged=without)


@pytest.fixture
def searches(monkeypatch):
    """Starts of all searches that are made of `part`: `searches(part)`."""

    def watch(part):
        made, search = [], part._search

        def searched(a, b, start=None, *rest, **more):
            made.append((a.bridged is None, start))
            return search(a, b, start, *rest, **more)

        monkeypatch.setattr(part, "_search", searched)
        return made

    return watch


@pytest.mark.parametrize("turn_reach", [0, 8])
def test_what_it_keeps_is_what_a_new_search_finds(operator, pair, turn_reach):
    part = operator(turn_reach=turn_reach)
    frames = pair(part)
    ask(part, frames, 4)
    found = ask(part, frames, 6)
    fresh = operator(turn_reach=turn_reach)
    alone = ask(fresh, pair(fresh), 6)
    for one, other in zip(found, alone, strict=True):
        assert np.array_equal(one.target, other.target)
        assert np.array_equal(one.confidence, other.confidence)


def test_other_masks_search_only_what_they_leave(operator, pair, searches):
    part = operator()
    frames, made = pair(part), searches(part)
    ask(part, frames, 4)
    assert [whole for whole, _ in made] == [True, True, False, False]
    made.clear()
    ask(part, frames, 6)
    assert [whole for whole, _ in made] == [False, False]
    made.clear()
    ask(part, frames, 6)
    assert made == []


def test_another_start_is_another_search(operator, pair, searches):
    part = operator()
    frames, made = pair(part), searches(part)
    start = ((frames[0].centres - part.offset) / part.stride).astype(np.float32)
    ask(part, frames, 4, start)
    made.clear()
    ask(part, frames, 6, start + np.float32(0.05))
    assert [whole for whole, _ in made] == [False, False]
    made.clear()
    ask(part, frames, 8, start + np.float32(1.0))
    assert [whole for whole, _ in made] == [True, True, False, False]


@pytest.mark.parametrize(("change", "again"), [(0.0, True), (0.02, False)])
def test_a_few_cells_more_or_less_need_no_new_search(operator, pair, searches, change, again):
    part = operator(bridge_change=change)
    frames, made = pair(part), searches(part)
    gate = closing(frames, 4)
    ask_by(part, frames, gate)
    made.clear()
    gate[:2, 4] = 0.0  # 2 of 300 cells more
    ask_by(part, frames, gate)
    assert bool(made) is again
    made.clear()
    ask(part, frames, 6)  # many more than when it was searched
    assert made


def test_the_oldest_is_given_up():
    kept = Kept(2)
    for key in ("a", "b", "a", "c"):
        kept.put(key, key)
    assert [kept.get(key) for key in "abc"] == ["a", None, "c"]


@pytest.mark.parametrize("order", ["cab", "bca"])
def test_what_is_given_up_does_not_depend_on_which_thread_was_first(order):
    kept = KeptInRounds(2)
    for key in order:
        kept.put(key, key)
        assert kept.get(key) == key
    assert kept.get(order[0]) == order[0]
    kept.settle()
    assert [kept.get(key) for key in "abc"] == [None, "b", "c"]
    kept.put("b", "anew")
    kept.settle()
    kept.put("d", "d")
    kept.settle()
    assert [kept.get(key) for key in "bcd"] == ["anew", None, "d"]


@pytest.mark.parametrize("order", [(4, 2, 3, 1), (1, 2, 3, 4)])
def test_of_more_than_there_is_room_for_the_next_round_finds_the_first(order):
    kept = KeptInRounds(2)
    for _ in range(2):
        kept.begin(order)
        found = [key for key in order if kept.get(key) is not None]
        for key in order:
            kept.put(key, key)
        kept.settle()
    assert sorted(found) == [1, 2]
    assert [kept.get(key) for key in (1, 2, 3, 4)] == [1, 2, None, None]
    kept.begin([5])
    kept.put(5, 5)
    kept.settle()
    assert [kept.get(key) for key in (1, 2, 5)] == [None, 2, 5]


def test_a_direction_that_is_not_wanted_sets_out_from_its_prediction(operator, pair, monkeypatch):
    part = operator()
    a, b = pair(part)
    height, width = a.normal.shape[:2]
    still = np.moveaxis(np.mgrid[:height, :width][::-1], 0, -1).astype(np.float32)
    asked, both_ways = [], part.both_ways

    def heard(one, other, start_ab, start_ba, *rest, **more):
        asked.append((start_ab, start_ba))
        return both_ways(one, other, start_ab, start_ba, *rest, **more)

    monkeypatch.setattr(part, "both_ways", heard)
    session = part.session("global")

    right = np.float32([5 / part.stride, 0])
    # the second time one of both is said to be where it is not: that one is searched again
    for there in (right, right + 40):
        coords = np.stack([still + there, still - right])
        seen = torch.ones(coords.shape[:3], dtype=torch.bool)
        known = torch.from_numpy(coords), seen, [a, b].__getitem__
        session.update(EdgeRequest([0, 1], [0, 1], [1, 0], *known, informed=True))
    assert len(asked) == 2
    assert all(np.array_equal(*both) for both in zip(asked[1], coords, strict=True))
