"""Whether tracking holds, and what the frontend does where it may not."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from droidw.config.schema import FrontendConfig, MotionFilterConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.graph.factors import FactorGraph
from droidw.graph.store import KeyframeInfo, KeyframeStore
from droidw.slam.doubt import (
    Link,
    explained_across,
    explained_around,
    explained_reach,
    explained_share,
    weakest_link,
)
from droidw.slam.frontend import Frontend

H, W = 6, 8


@pytest.fixture
def measured():
    """Two keyframes and an edge each way, measured where poses and depths put it."""
    store = KeyframeStore(Grid(H, W, 8, 3.5), torch.tensor([60.0, 60.0, 31.5, 23.5]))
    for k in range(2):
        info = KeyframeInfo(k, k / 10, "", np.zeros((48, 64, 3), np.uint8), None)
        store.append(info, T_cw=torch.tensor([0.1 * k, 0, 0, 0, 0, 0, 1]))
    graph = FactorGraph(H, W)
    graph.add([(0, 1), (1, 0)])
    place, _ = reproject(store.T_cw, store.disps, store.intrinsics, *graph.index([0, 1]))
    graph.record([0, 1], place, torch.ones(2, H, W, 3))
    return store, graph, torch.ones(2, H, W)


def test_all_agrees_with_the_poses_it_was_made_from(measured):
    store, graph, gates = measured
    assert explained_share(store, graph, [0, 1], gates) == pytest.approx(1.0)


def test_share_is_that_of_confidence_times_gate(measured):
    store, graph, gates = measured
    target, confidence = graph.target.clone(), graph.confidence.clone()
    target[:, :, W // 2 :] += torch.tensor([0.2, 0.0])  # agrees by half
    graph.record([0, 1], target, confidence)
    assert explained_share(store, graph, [0, 1], gates) == pytest.approx(0.75)
    confidence[:, :, W // 2 :] *= 0.5
    graph.record([0, 1], target, confidence)
    assert explained_share(store, graph, [0, 1], gates) == pytest.approx((1 + 0.25) / 1.5)
    gates[:, :, : W // 2] = 0.0
    assert explained_share(store, graph, [0, 1], gates) == pytest.approx(0.5)


def test_share_around_a_keyframe_is_that_of_its_edges(measured):
    store, graph, gates = measured
    info = KeyframeInfo(2, 0.2, "", np.zeros((48, 64, 3), np.uint8), None)
    store.append(info, T_cw=torch.tensor([0.2, 0, 0, 0, 0, 0, 1]))
    gates = torch.cat([gates, gates[:1]])
    assert explained_around(store, graph, [0, 1], gates).tolist() == pytest.approx([1, 1, 0])
    graph.add([(1, 2), (2, 1)])
    place, _ = reproject(store.T_cw, store.disps, store.intrinsics, *graph.index([2, 3]))
    graph.record([2, 3], place + torch.tensor([0.2, 0.0]), torch.ones(2, H, W, 3))  # agree by half
    rows = [0, 1, 2, 3]
    around = explained_around(store, graph, rows, gates)
    assert around[0] == pytest.approx(1.0)
    assert 0.5 < around[1] < 1.0
    assert around[2] == pytest.approx(0.5)
    # what was not measured does not count
    confidence = graph.confidence.clone()
    confidence[3] = float("nan")
    graph.record(rows, graph.target.clone(), confidence)
    assert explained_around(store, graph, rows, gates)[2] == pytest.approx(0.5)
    confidence[2] = 0.0
    graph.record(rows, graph.target.clone(), confidence)
    assert explained_around(store, graph, rows, gates).tolist() == pytest.approx([1, 1, 0])


def test_a_break_shows_in_what_was_measured_across_it(measured):
    """Two pieces of three keyframes, each sound by itself."""
    store, graph, gates = measured
    for k in range(2, 6):
        info = KeyframeInfo(2 * k, k / 10, "", np.zeros((48, 64, 3), np.uint8), None)
        store.append(info, T_cw=torch.tensor([0.1 * k, 0, 0, 0, 0, 0, 1]))
    gates = torch.ones(6, H, W)
    pairs = [(k, k + 1) for k in range(1, 5)] + [(1, 3), (4, 2), (0, 4)]
    graph.add([edge for i, j in pairs for edge in ((i, j), (j, i))])
    rows = graph.select()
    place, _ = reproject(store.T_cw, store.disps, store.intrinsics, *graph.index(rows))
    ii, jj = graph.index(rows)
    astray = (torch.minimum(ii, jj) <= 2) & (torch.maximum(ii, jj) > 2)
    target = place + 5.0 * astray[:, None, None, None]
    graph.record(rows, target, torch.ones(len(rows), H, W, 3))
    across = explained_across(store, graph, rows, gates)
    assert across.shape == (5,)
    assert across[2] < 0.01
    assert across[0] == pytest.approx(2 / 4, abs=0.1)  # half of its edges lead across the break
    assert across[4] == pytest.approx(1.0)
    found = weakest_link(store, graph, rows, gates)
    assert found == Link(pytest.approx(float(across[2])), frame=4)
    assert found.broken(0.15) and not found.broken(0.0)
    assert explained_share(store, graph, rows, gates) > 0.4
    # where nothing was measured nothing has broken
    weight = torch.where(astray[:, None, None, None], 0.0, 1.0).expand(-1, H, W, 3)
    graph.record(rows, target, weight.contiguous())
    assert explained_across(store, graph, rows, gates).tolist() == pytest.approx([1.0] * 5)


def test_a_link_that_is_not_known_is_not_broken(measured):
    store, _, gates = measured
    assert not Link().broken(1.0)
    alone = KeyframeStore(store.grid, store.intrinsics.clone())
    assert math.isnan(weakest_link(alone, FactorGraph(H, W), [], gates[:0]).share)


def test_what_is_broken_or_not_there_does_not_count(measured):
    store, graph, gates = measured
    target, confidence = graph.target.clone(), graph.confidence.clone()
    target[0, 0, 0] = float("nan")
    confidence[1, 0, 0] = float("nan")
    graph.record([0, 1], target, confidence)
    target[0, 1, 1] += 1e3
    graph.record([0, 1], target, confidence)
    share = explained_share(store, graph, [0, 1], gates)
    assert share == pytest.approx((2 * H * W - 3) / (2 * H * W - 2), abs=1e-6)
    assert explained_share(store, graph, [0, 1], 0 * gates) == 1.0


@pytest.mark.parametrize(
    ("off", "keep_below", "dropped"), [(0.0, 0.6, 1), (2.0, 0.6, None), (2.0, 0.0, 1)]
)
def test_a_near_keyframe_is_dropped_only_where_tracking_holds(measured, off, keep_below, dropped):
    store, graph, gates = measured
    graph.record([0, 1], graph.target + off, graph.confidence.clone())
    frontend = Frontend.__new__(Frontend)
    frontend.store, frontend.graph, frontend._drops = store, graph, 0
    frontend.options = FrontendConfig(keyframe_threshold=100.0, keep_below=keep_below)
    frontend.config = SimpleNamespace(motion_filter=MotionFilterConfig())
    frontend.optimiser = SimpleNamespace(gates=lambda: gates)
    assert frontend._redundant() == dropped


@pytest.mark.parametrize(
    ("rows", "above", "times", "dropped"),
    [(0, 0.1, 1.01, 1), (2, 0.1, 1.49, None), (2, 0.1, 1.51, 1), (2, 0.0, 1.01, 1)],
)
@pytest.mark.parametrize("masked", [False, True])
def test_keyframes_are_nearer_where_something_is_hidden(
    measured, rows, above, times, dropped, masked
):
    """Dropped below a distance, which is less by the share of six rows that can move."""
    store, graph, gates = measured
    frontend = Frontend.__new__(Frontend)
    frontend.store, frontend.graph, frontend._drops = store, graph, 0
    frontend.config = SimpleNamespace(
        motion_filter=MotionFilterConfig(movable_above=above, movable_nearer=1.0)
    )
    frontend.optimiser = SimpleNamespace(gates=lambda: gates)
    frontend.options = FrontendConfig()
    distance = frontend._between(0, 1)
    frontend.options.keyframe_threshold = times * distance
    if masked:  # whatever is asked of what can move
        store["unmasked"][1, : rows if above else 0] = 0.0
    else:
        store["movable"][1, :rows] = 0.5
    assert frontend._redundant() == dropped


def test_what_agrees_reaches_as_far_as_its_cells_are_spread(measured):
    """A quarter of all cells agree: one corner of the picture, or every other row and column."""
    store, graph, gates = measured
    assert explained_reach(store, graph, [0, 1], gates) == pytest.approx(1.0)
    corner = torch.zeros(H, W, dtype=torch.bool)
    corner[: H // 2, : W // 2] = True
    spread = torch.zeros(H, W, dtype=torch.bool)
    spread[::2, ::2] = True
    target, reach = graph.target.clone(), []
    for cells in (corner, spread):
        elsewhere = torch.where(cells[..., None], 0.0, 1e3)
        graph.record([0, 1], target + elsewhere, graph.confidence[[0, 1]])
        reach.append(explained_reach(store, graph, [0, 1], gates))
    # variances of runs of 3 and 4 cells against those of 6 and 8
    assert reach[0] == pytest.approx(0.25 * math.sqrt((8 / 35) * (15 / 63)), rel=1e-3)
    assert reach[1] == pytest.approx(0.25 * math.sqrt((32 / 35) * (60 / 63)), rel=1e-3)


def test_nothing_reaches_anywhere_where_nothing_was_measured(measured):
    store, graph, gates = measured
    assert explained_reach(store, graph, [0, 1], 0 * gates) == 0.0
