"""Keyframes from between the others: which frames, with what, and at which places."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from droidw.config.schema import DroidwConfig
from droidw.geometry.camera import Grid
from droidw.geometry.interpolate import interpolate
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import inv, log, mul
from droidw.graph.factors import FactorGraph
from droidw.slam.between import Between, chosen, inherited
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.timing import Stopwatch

GRID, INTRINSICS, EVERY = Grid(8, 12, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5]), 4


@pytest.mark.parametrize(
    ("keyframes", "most", "expected"),
    [
        ([0, 4, 5, 9], 1, [2, 7]),
        ([0, 4, 5, 9], 2, [1, 3, 6, 8]),
        ([0, 4, 5, 9], 5, [1, 2, 3, 6, 7, 8]),
        ([0, 4, 5, 9], 0, []),
        ([0, 2, 4], 1, [1, 3]),
        ([3, 4, 5], 1, []),
        ([4], 1, []),
        ([], 1, []),
    ],
)
def test_frames_part_each_gap_evenly(keyframes, most, expected) -> None:
    assert chosen(keyframes, range(12), most) == expected


def test_only_frames_that_there_are_become_keyframes() -> None:
    assert chosen([0, 10, 20], [0, 1, 2, 10, 20, 21], 1) == [2]
    assert chosen([0, 10, 20], [0, 1, 2, 10, 20, 21], 3) == [1, 2]


@pytest.fixture
def sparse(arc, waves, stored):
    """A store with every fourth frame of a path, all poses of it, and who adds the others.

    Frames are located halfway between their keyframes, as the filler does without a measurement.
    """

    def make(missing=(), **options):
        count = 5
        store = stored(GRID, INTRINSICS.clone(), arc(count), waves(count, GRID.height, GRID.width))
        for k, info in enumerate(store.infos):
            store.infos[k] = SimpleNamespace(**{**vars(info), "index": EVERY * k})
            store["through"][k] = k
        config = DroidwConfig()
        config.filler.updates = 0
        for name, value in options.items():
            setattr(config.backend, name, value)
        optimiser = Optimiser(
            store, Parts(None, None, None, None, None), config.weighting, Stopwatch()
        )
        asked, given = [], []

        def encoded(indices):
            asked.append(indices)
            for index in sorted(indices - set(missing)):
                frame = SimpleNamespace(index=index, time=index / EVERY / 10)
                yield SimpleNamespace(frame=frame)

        def insert(made):
            given.append([(one.frame.index, known) for one, known in made])
            for one, known in made:
                info = SimpleNamespace(index=one.frame.index, time=one.frame.time)
                store.append(info, **known)
            store.sort()

        indices = list(range(EVERY * (count - 1) + 1))
        return store, Between(optimiser, config, indices, encoded, insert), asked, given

    return make


def test_a_frame_has_the_depth_of_the_keyframe_beside_it(sparse) -> None:
    store, between, _, given = sparse()
    poses, disps = store.T_cw.clone(), store.disps.clone()
    between.add()
    assert [info.index for info in store.infos] == list(range(0, 17, 2))
    assert torch.equal(store.T_cw[::2], poses)
    assert torch.equal(store.disps[::2], disps)
    for k, (index, known) in enumerate(given[0]):
        assert index == EVERY * k + 2
        off = log(mul(known["T_cw"], inv(interpolate(poses[k], poses[k + 1], 0.5))))
        assert float(off.norm()) < 1e-5
        # Depths of either keyframe look alike from there: a wall with waves.
        assert float((known["disps"] / disps[k]).log().abs().median()) < 0.2
        assert known["through"].unique().tolist() in ([k], [k + 1])


def test_they_are_added_once_and_taken_out_again(sparse) -> None:
    store, between, asked, _ = sparse()
    poses = store.T_cw.clone()
    between.add()
    between.add()
    assert len(asked) == 1
    assert len(store) == 9
    between.remove()
    assert torch.equal(store.T_cw, poses)
    between.add()
    assert len(store) == 9


@pytest.mark.parametrize(
    ("moved", "unmeasured", "left"),
    [
        ((), (), [0, 2, 4, 6, 8, 10, 12, 14, 16]),
        ((3,), (), [0, 2, 4, 8, 10, 12, 14, 16]),
        ((1, 5), (), [0, 4, 6, 8, 12, 14, 16]),
        # those that were there before stay, whatever became of them
        ((4,), (), [0, 2, 4, 6, 8, 10, 12, 14, 16]),
        ((), (7,), [0, 2, 4, 6, 8, 10, 12, 16]),
    ],
    ids=["none", "one", "two", "an old one", "nothing was measured about it"],
)
def test_what_came_loose_is_taken_out(sparse, moved, unmeasured, left) -> None:
    store, between, asked, _ = sparse()
    between.add()
    count = len(store)
    graph = FactorGraph(GRID.height, GRID.width)
    graph.add([(i, j) for i in range(count) for j in range(count) if i != j])
    rows = graph.select()
    ii, jj = graph.index(rows)
    place, _ = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
    confidence = torch.ones(len(rows), GRID.height, GRID.width, 3)
    for k in unmeasured:
        confidence[(ii == k) | (jj == k)] = 0.0
    graph.record(rows, place, confidence)
    for k in moved:
        store.T_cw[k, 0] += 1.0
    between.remove_loose(graph, torch.ones(count, GRID.height, GRID.width))
    assert [info.index for info in store.infos] == left
    assert [left[k] for k in between.old()] == [0, 4, 8, 12, 16]
    between.add()  # what came loose once would do so again
    assert [info.index for info in store.infos] == left
    between.remove()
    assert len(store) == 5
    between.add()
    assert len(asked) == 2


@pytest.mark.parametrize("missing", [(), (2, 6, 10, 14)], ids=["not asked yet", "none came"])
def test_where_none_are_from_between_none_is_loose(sparse, missing) -> None:
    store, between, _, _ = sparse(missing)
    if missing:
        between.add()
    assert not between.made
    between.remove_loose(
        FactorGraph(GRID.height, GRID.width), torch.ones(5, GRID.height, GRID.width)
    )
    assert len(store) == 5


@pytest.mark.parametrize(
    ("options", "missing", "left"),
    [({"between": 0}, (), 5), ({"between": 3}, (), 17), ({}, (2, 6, 10, 14), 5), ({}, (6,), 8)],
    ids=["none wanted", "all", "all are lost", "one is lost"],
)
def test_as_many_as_wanted_and_readable(sparse, options, missing, left) -> None:
    store, between, asked, _ = sparse(missing, **options)
    between.add()
    assert len(store) == left
    assert bool(asked) == (options.get("between") != 0)  # nothing is read for nothing


@pytest.mark.parametrize(
    ("options", "missing", "expected"),
    [
        ({}, (), [0, 2, 4, 6, 8]),
        ({"between": 3}, (6, 7), [0, 4, 6, 10, 14]),
        ({"between": 0}, (), [0, 1, 2, 3, 4]),
    ],
)
def test_where_the_others_are_now(sparse, options, missing, expected) -> None:
    _, between, _, _ = sparse(missing, **options)
    assert between.old() == [0, 1, 2, 3, 4]
    between.add()
    assert between.old() == expected
    between.remove()
    assert between.old() == [0, 1, 2, 3, 4]


def both_ways(*pairs):
    return sorted(pair for i, j in pairs for pair in ((i, j), (j, i)))


def test_new_keyframes_share_the_edges_of_the_one_before() -> None:
    edges = both_ways((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
    found = inherited(edges, [0, 2, 4, 6], 7)
    kept = [(0, 2), (0, 4), (2, 4), (0, 6), (2, 6), (4, 6)]
    beside = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6)]
    # of 0 the first and third of 2 4 6; of 2 the second of 0 4 6; of 4 the first and third of 0 2 6
    shared = [(1, 2), (1, 6), (3, 4), (0, 5), (5, 6)]
    assert sorted(found) == both_ways(*{*kept, *beside, *shared})
    assert len(set(found)) == len(found)


def test_a_gap_without_a_new_one_keeps_its_edges() -> None:
    edges = both_ways((0, 1), (1, 2), (0, 2))
    assert sorted(inherited(edges, [0, 1, 2], 3)) == edges
    found = inherited(edges, [0, 1, 3], 4)
    assert {(1, 2), (2, 3)} <= set(found)
    assert sorted(inherited(edges, [0, 1, 2], 4)) == both_ways(
        (0, 1), (1, 2), (0, 2), (2, 3), (0, 3)
    )


def test_near_and_far_edges_stay_in_proportion() -> None:
    """Two in each gap, of a chain with links up to four apart."""
    count = 30
    edges = [(i, j) for i in range(count) for j in range(count) if 0 < abs(i - j) <= 4]
    old = list(range(0, 3 * count, 3))
    found = inherited(edges, old, 3 * count - 2)

    def reach(pairs, step):
        apart = np.asarray([abs(i - j) / step for i, j in pairs if abs(i - j) > 2])
        return np.histogram(apart, bins=[0.9, 1.5, 2.5, 3.5, 4.9])[0] / len(apart)

    assert np.abs(reach(found, 3) - reach([(3 * i, 3 * j) for i, j in edges], 3)).max() < 0.06
