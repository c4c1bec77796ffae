"""Pairs that global adjustment has searched are matched again by windows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from droidw.geometry.camera import Grid
from droidw_plugins.correspondence._flow_again import but_for_closed
from droidw_plugins.correspondence._flow_mask import bridge
from droidw_plugins.correspondence._flow_types import Edge

H, W, MOVED = 120, 160, 5.3


@pytest.fixture
def pair(frame):
    """`pair(part, cover=None)`: two encoded pictures, the second moved by 5.3 pixels.

    With `cover` its first columns show what the first picture has not.
    """
    rng = np.random.default_rng(4)
    fine = cv2.GaussianBlur(rng.normal(size=(H, 2 * W)).astype(np.float32), (0, 0), 2.0)
    wide = np.clip(128 + 40 * fine / fine.std(), 0, 255)
    y, x = np.mgrid[:H, :W].astype(np.float32)

    def moved(by):
        return cv2.remap(wide, x + 60 - np.float32(by), y, cv2.INTER_LANCZOS4)

    def call(part, cover=0):
        grid = Grid.of(H, W, part.stride, part.offset)
        second = moved(MOVED)
        second[:, :cover] = wide[:, W : W + cover]
        return [part.encode(frame(k, p), grid) for k, p in enumerate((moved(0.0), second))]

    return call


def predicted(part, frames, off=0.0):
    """Targets both ways as they are, but for so many cells."""
    cells = (frames[0].centres - part.offset) / part.stride
    step = np.array([MOVED / part.stride + off, 0.0])
    return (cells + step).astype(np.float32), (cells - step).astype(np.float32)


def ask(part, frames, *, closed=0, off=0.0, fine=True, seeded=False):
    """Both edges where the first columns of cells are closed in both pictures."""
    gate = np.ones(frames[0].normal.shape[:2], np.float32)
    gate[:, :closed] = 0.0
    without = tuple(bridge(f, gate, 0.5, 7, part.options.blur) for f in frames)
    starts = predicted(part, frames, off)
    return part.both_ways(*frames, *starts, fine=fine, bridged=without, seeded=seeded)


@pytest.fixture
def searches(monkeypatch):
    """Searches that are made of `part`: `searches(part)`."""

    def watch(part):
        made, search = [], part._search

        def searched(*args, **more):
            made.append(args[:2])
            return search(*args, **more)

        monkeypatch.setattr(part, "_search", searched)
        return made

    return watch


def off_by(part, frames, edge):
    """Pixels by which sure matches of the edge forward are off, [n]."""
    sure = edge.confidence[..., :2].min(axis=-1) > 0.3
    assert sure.mean() > 0.3
    off = part.stride * (edge.target - predicted(part, frames)[0])
    return np.linalg.norm(off[sure], axis=-1)


@pytest.mark.parametrize("change", [{"closed": 6}, {"off": 0.3}, {"closed": 6, "off": 0.3}])
def test_a_pair_that_was_searched_is_not_searched_again(operator, pair, searches, change):
    part = operator()
    frames = pair(part)
    ask(part, frames, closed=4)
    made = searches(part)
    edge, _ = ask(part, frames, **change)
    assert made == []
    assert np.median(off_by(part, frames, edge)) < 0.05


@pytest.mark.parametrize(
    ("options", "change"),
    [
        ({"again_window": 0}, {"off": 0.3}),
        ({"warp": False}, {"off": 0.3}),
        ({}, {"off": 1.0}),  # more than windows reach
        ({}, {"off": 0.3, "fine": False}),  # while tracking
        ({}, {"closed": 4, "seeded": True}),  # points are asked that were not
    ],
)
def test_else_it_is(operator, pair, searches, options, change):
    part = operator(**options)
    frames = pair(part)
    ask(part, frames, closed=4, fine=change.get("fine", True))
    made = searches(part)
    ask(part, frames, **change)
    assert made


def test_points_that_were_asked_count_for_who_does_not_want_them(operator, pair, searches):
    part = operator()
    frames = pair(part)
    ask(part, frames, seeded=True)
    made = searches(part)
    edge, _ = ask(part, frames)
    assert made == [] and edge.seeded
    edge, _ = ask(part, frames, closed=6)
    assert made == [] and edge.seeded


def test_windows_are_as_exact_as_a_search(operator, pair):
    off = {}
    for window in (0, 9):
        part = operator(again_window=window)
        frames = pair(part)
        ask(part, frames, off=0.3)
        edge, _ = ask(part, frames)
        off[window] = np.median(off_by(part, frames, edge))
    assert off[9] < 1.2 * off[0] + 0.01


def test_what_is_closed_keeps_what_was_found_and_is_softened_once(operator, pair):
    part = operator()
    frames = pair(part)
    whole, _ = ask(part, frames)
    closed = np.s_[1:-1, 1:4]
    for off in (0.1, 0.3):
        edge, _ = ask(part, frames, closed=5, off=off)
        np.testing.assert_array_equal(edge.target[closed], whole.target[closed])
        share = np.float32(part.options.bridged_share)
        np.testing.assert_allclose(edge.confidence[closed], share * whole.confidence[closed])
        assert edge.bridged[closed].all() and not edge.bridged[:, 5:].any()


def test_what_opens_again_is_matched_again(operator, pair):
    part = operator()
    frames = pair(part)
    ask(part, frames, closed=8)
    edge, _ = ask(part, frames)
    assert edge.bridged is None
    fresh = operator()
    alone, _ = ask(fresh, pair(fresh))
    opened = np.s_[2:-2, 2:7]
    assert edge.confidence[opened].mean() > 0.9 * alone.confidence[opened].mean()
    assert np.median(off_by(part, frames, edge)) < 0.05


def test_a_match_that_was_far_from_what_is_predicted_does_not_lead_a_window(operator, pair):
    part = operator()
    frames = pair(part)
    ask(part, frames)
    key = (frames[0].key, frames[1].key, True)
    there, _ = part._pairs.get(key)
    there.target[:, 8:] += np.float32(1.0)  # eight pixels astray, and sure of it
    edge, _ = ask(part, frames, off=0.2)
    assert np.median(off_by(part, frames, edge)) < 0.05
    assert off_by(part, frames, edge).max() < 1.0


def test_pictures_that_changed_are_believed_no_more_than_after_a_search(operator, pair):
    """What covers the second picture is not found, by windows neither."""
    part = operator()
    frames = pair(part, cover=64)
    ask(part, frames)
    edge, _ = ask(part, frames, off=0.2)
    covered = edge.confidence[2:-2, :6]
    seen = edge.confidence[2:-2, 9:-2]
    assert covered[..., :2].mean() < 0.1 * seen[..., :2].mean()


def test_nothing_closed_leaves_an_edge_as_it_is():
    target = np.zeros((2, 3, 2), np.float32)
    edge = Edge(target, np.ones((2, 3, 3), np.float32), None)
    before = Edge(target + 1, np.ones((2, 3, 3), np.float32), None, seeded=True)
    same = but_for_closed(edge, before, None, 0.2)
    assert same.target is edge.target and same.confidence is edge.confidence and same.seeded
