"""Which edges are proposed from a matrix of distances."""

from __future__ import annotations

import numpy as np
import pytest

from droidw.graph.proximity import backend_edges, frontend_edges, neighbour_edges

WINDOW = {"radius": 2, "nms": 1, "threshold": 8.0, "max_factors": 75}


def test_neighbours():
    assert neighbour_edges(1, 3) == []
    assert set(neighbour_edges(4, 2)) == {
        (i, j) for i in range(4) for j in range(4) if 1 <= abs(i - j) <= 2
    }


def symmetric(edges):
    return all((j, i) in edges for i, j in edges) and len(set(edges)) == len(edges)


def test_window_links_predecessors_whatever_their_distance():
    edges = frontend_edges(np.full((3, 6), np.inf), 3, 0, (), **WINDOW)
    expected = {(i, j) for i in (3, 4, 5) for j in range(i - 3, i)}
    assert set(edges) == expected | {(j, i) for i, j in expected}
    assert symmetric(edges)


def test_window_takes_near_pairs_nearest_first():
    d = np.full((10, 10), 20.0)
    d[9, 1], d[8, 4] = 2.0, 1.0
    forced = frontend_edges(np.full((10, 10), np.inf), 0, 0, (), **WINDOW)
    edges = frontend_edges(d, 0, 0, (), **WINDOW)
    assert edges[: len(forced)] == forced
    assert edges[len(forced) :] == [(8, 4), (4, 8), (9, 1), (1, 9)]


@pytest.mark.parametrize(("near", "taken"), [((9, 2), False), ((8, 1), False), ((8, 2), True)])
def test_window_suppresses_around_edges_that_are_there(near, taken):
    d = np.full((10, 10), np.inf)
    d[near] = 1.0
    edges = frontend_edges(d, 0, 0, [(9, 1)], **WINDOW)
    assert (near in edges) is taken


def test_window_never_proposes_the_future_or_the_far():
    d = np.zeros((6, 6))
    d[5, 0] = 101.0
    edges = frontend_edges(d, 0, 0, (), radius=2, nms=0, threshold=1e9, max_factors=1000)
    assert (5, 0) not in edges and symmetric(edges)
    assert all(i != j for i, j in edges)


def test_window_stops_at_the_largest_number():
    d = np.random.default_rng(0).uniform(0, 5, (5, 30))
    options = {"radius": 1, "nms": 0, "threshold": 8.0}
    many = frontend_edges(d, 25, 0, (), max_factors=1000, **options)
    few = frontend_edges(d, 25, 0, (), max_factors=40, **options)
    assert len(few) == 42 < len(many), "the pair that passes the limit is the last"
    assert few == many[:42]
    assert symmetric(few)


def test_the_matrix_given_is_left_alone():
    d = np.ones((5, 5))
    frontend_edges(d, 0, 0, (), **WINDOW)
    backend_edges(d, radius=1, nms=1, threshold=5.0, max_factors=50)
    assert (d == 1).all()


def test_global_links_predecessors_and_near_pairs():
    d = np.full((12, 12), np.inf)
    d[11, 2], d[10, 2], d[6, 0] = 1.0, 1.5, 30.0
    edges = backend_edges(d, radius=1, nms=1, threshold=25.0, max_factors=200)
    linked = {(i, j) for i in range(12) for j in range(max(0, i - 2), i)}
    assert linked <= set(edges)
    assert (11, 2) in edges
    assert (10, 2) not in edges, "a neighbour of a chosen edge is suppressed"
    assert (6, 0) not in edges, "too far"
    assert symmetric(edges)


def test_global_ties_go_by_index_and_stop_in_time():
    d = np.full((20, 20), 3.0)
    edges = backend_edges(d, radius=1, nms=0, threshold=25.0, max_factors=90)
    assert edges == backend_edges(d.copy(), radius=1, nms=0, threshold=25.0, max_factors=90)
    assert 90 < len(edges) <= 92
    chosen = [e for e in edges if e[0] - e[1] > 2]
    assert chosen == sorted(chosen)


@pytest.mark.parametrize("square", [False, True], ids=["diamond", "square"])
def test_half_steps_suppress_twice_as_many(square):
    """As if every other keyframe were not there: suppression counts steps, not keyframes."""
    count, options = 20, {"radius": 1, "nms": 2, "threshold": 25.0, "max_factors": 1000}
    d = np.full((2 * count, 2 * count), np.inf)
    d[::2, ::2] = np.random.default_rng(1).uniform(0, 20, (count, count))
    linked = np.subtract.outer(np.arange(2 * count), np.arange(2 * count)) <= 4
    d[linked] = np.inf

    def chosen(d, spans=None):
        if square:
            edges = backend_edges(d, spans=spans, **options)
        else:
            edges = frontend_edges(d, 0, 0, (), spans=spans, **options)
        return {(i, j) for i, j in edges if np.isfinite(d[i, j])}

    every_other = {(2 * i, 2 * j) for i, j in chosen(d[::2, ::2])}
    half = chosen(d, np.full(2 * count, 0.5))
    assert half and half == every_other
    assert len(chosen(d)) > len(half)


def test_steps_are_summed_without_gaps():
    """Ten tenths are one step, whatever rounding makes of their sum."""
    d = np.full((40, 40), np.inf)
    d[30, 5], d[30, 15] = 1.0, 2.0
    options = {"radius": 1, "nms": 1, "threshold": 25.0, "max_factors": 1000}
    edges = backend_edges(d, spans=np.full(40, 0.1), **options)
    assert (30, 5) in edges and (30, 15) not in edges
    assert (30, 15) in backend_edges(d, spans=np.full(40, 0.11), **options)
