"""The factor graph: adding, retiring, dropping, and renumbering after a removed keyframe."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.graph.factors import FactorGraph


def graph_of(*pairs):
    graph = FactorGraph(2, 3)
    graph.add(pairs)
    mark(graph)
    return graph


def mark(graph):
    """Write each edge's id into its target and confidence, to see that they move along."""
    for row, number in enumerate(graph.ids):
        graph.target[row] = number
        graph.confidence[row] = -number


def check(graph):
    assert len(graph) == len(graph.ii) == len(graph.jj) == len(graph.age) == len(graph.active)
    assert graph.target.shape == graph.confidence.shape == (len(graph), 2, 3, 2)
    assert len(set(graph.ids)) == len(graph) == len(set(graph.pairs))
    for row, number in enumerate(graph.ids):
        assert (graph.target[row] == number).all()
        assert (graph.confidence[row] == -number).all()


def test_add_leaves_out_what_is_there_or_loops():
    graph = graph_of((0, 1), (1, 0))
    assert graph.add([(0, 1), (2, 2), (1, 2), (1, 2)]) == [2]
    assert graph.pairs == [(0, 1), (1, 0), (1, 2)]
    assert graph.ids == [0, 1, 2]
    assert (graph.target[2] == 0).all()
    assert graph.add([]) == []


def test_retired_edges_stay_and_are_not_added_again():
    graph = graph_of((0, 1), (1, 0), (1, 2))
    assert graph.retire([0, 2]) == [0, 2]
    assert graph.retire([0]) == []
    assert graph.select() == [1]
    assert graph.select(active=False) == [0, 2]
    assert graph.add([(0, 1)]) == []
    check(graph)


def test_ids_never_repeat():
    graph = graph_of((0, 1), (1, 0))
    graph.drop([1])
    graph.add([(1, 0)])
    assert graph.ids == [0, 2]


def test_drop():
    graph = graph_of((0, 1), (1, 0), (1, 2), (2, 1))
    assert graph.drop([]) == []
    assert graph.drop([3, 1]) == [1, 3]
    assert graph.pairs == [(0, 1), (1, 2)]
    check(graph)


def test_drop_before_spares_active_edges():
    graph = graph_of((0, 5), (5, 0), (4, 5), (5, 4))
    graph.retire([0, 2])
    assert graph.drop_before(3) == [0]
    assert graph.pairs == [(5, 0), (4, 5), (5, 4)]
    check(graph)


def test_oldest():
    graph = graph_of((0, 1), (1, 0), (1, 2), (2, 1))
    graph.grow_older([1], by=3)
    graph.grow_older([0, 3])
    graph.retire([3])
    assert graph.oldest(keep=1) == [1, 0]
    assert graph.oldest(keep=5) == []
    graph.grow_older([2], by=-4)
    assert graph.age == [1, 3, 0, 1]


def test_index():
    ii, jj = graph_of((0, 1), (4, 2)).index([1, 0])
    assert ii.tolist() == [4, 0] and jj.tolist() == [2, 1]
    assert ii.dtype == jj.dtype == torch.int64


@pytest.mark.parametrize("seed", range(5))
def test_remove_keyframe_against_a_plain_model(seed):
    rng = np.random.default_rng(seed)
    graph, count = FactorGraph(2, 3), 9
    model: dict[int, tuple[int, int]] = {}
    for _ in range(25):
        if count > 3 and rng.random() < 0.3:
            at = int(rng.integers(count))
            gone = graph.remove_keyframe(at)
            assert sorted(gone) == sorted(n for n, pair in model.items() if at in pair)
            model = {
                n: (i - (i > at), j - (j > at)) for n, (i, j) in model.items() if at not in (i, j)
            }
            count -= 1
        else:
            pairs = [tuple(int(v) for v in rng.integers(count, size=2)) for _ in range(4)]
            for row in graph.add(pairs):
                model[graph.ids[row]] = graph.pairs[row]
            mark(graph)
            count += 1
        assert dict(zip(graph.ids, graph.pairs, strict=True)) == model
        check(graph)


def full(count, value):
    """Information of `count` edges of 2x3 cells."""
    return torch.tensor([2.0, 3.0, value]).expand(count, 2, 3, 3)


def test_two_channels_stay_two_and_are_kept_as_they_are():
    graph = graph_of((0, 1), (1, 0), (1, 2))
    target, confidence = torch.randn(2, 2, 3, 2), torch.rand(2, 2, 3, 2)
    graph.record([2, 0], target, confidence)
    assert graph.confidence.shape == (3, 2, 3, 2)
    assert torch.equal(graph.confidence[[2, 0]], confidence)
    assert torch.equal(graph.target[[2, 0]], target)
    assert (graph.target[1] == 1).all()


def test_the_first_off_diagonal_makes_room_for_all():
    graph = graph_of((0, 1), (1, 0), (1, 2))
    graph.record([1], torch.ones(1, 2, 3, 2), full(1, 0.5))
    assert graph.confidence.shape == (3, 2, 3, 3)
    assert torch.equal(graph.confidence[1:2], full(1, 0.5))
    assert (graph.confidence[2] == torch.tensor([-2.0, -2.0, 0.0])).all()
    # later answers of two channels have no off-diagonal, new edges nothing at all
    graph.record([1], torch.ones(1, 2, 3, 2), full(1, 0.0)[..., :2])
    assert torch.equal(graph.confidence[1:2], full(1, 0.0))
    graph.add([(2, 1)])
    assert graph.confidence.shape == (4, 2, 3, 3)
    assert (graph.confidence[3] == 0).all()
    graph.drop([0])
    assert torch.equal(graph.confidence[0:1], full(1, 0.0))
