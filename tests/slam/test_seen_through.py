"""What keyframes see through, and what global adjustment makes of it."""

from __future__ import annotations

import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import DroidwConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import pixel_grid, reproject
from droidw.graph.factors import FactorGraph
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.interfaces.uncertainty import UncertaintyReport
from droidw.slam import seen_through as module
from droidw.slam.backend import Backend
from droidw.slam.focal import FocalSearch
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.records import keyframe_records
from droidw.slam.seen_through import (
    evidence,
    moves_ahead,
    open_though_seen_through,
    seen_through,
)
from droidw.slam.timing import Stopwatch
from droidw.solve.weights import CLOSED, gate
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

GRID, INTRINSICS, COUNT = Grid(12, 16, 8, 3.5), torch.tensor([100.0, 100.0, 63.5, 47.5]), 12
THING = (slice(3, 10), slice(4, 12))  # cells of what goes ahead
INNER = (slice(5, 8), slice(6, 10))
WALL, AWAY = 0.25, 0.05  # disparities of what stands, and of what goes ahead as it seems


@pytest.fixture
def ahead(stored):
    """Keyframes that pass a wall, a graph that says so, and gates that are open.

    The first four see something that goes with the camera, and seems far away.
    """

    def make(away=AWAY):
        T_cw = torch.zeros(COUNT, 7)
        T_cw[:, 6] = 1.0
        T_cw[:, 0] = -0.1 * torch.arange(COUNT)
        disps = torch.full((COUNT, GRID.height, GRID.width), WALL)
        disps[:4, THING[0], THING[1]] = away
        store = stored(GRID, INTRINSICS, T_cw, disps)
        graph = FactorGraph(GRID.height, GRID.width)
        rows = graph.add((i, j) for i in range(COUNT) for j in range(COUNT) if 0 < abs(i - j) < 3)
        target, _ = reproject(T_cw, disps, store.intrinsics, *graph.index(rows))
        confidence = torch.ones_like(target)
        # What hides the wall has no match on it.
        confidence[[r for r in rows if (graph.ii[r] < 4) != (graph.jj[r] < 4)]] = 0.0
        graph.record(rows, target, confidence)
        return store, graph, torch.ones_like(disps)

    return make


def test_what_goes_ahead_is_seen_through_and_what_stands_is_not(ahead) -> None:
    through = seen_through(*ahead())
    assert float(through[:4, INNER[0], INNER[1]].min()) > 0.5
    around = torch.ones_like(through, dtype=torch.bool)
    around[:4, 2:11, 3:13] = False
    assert float(evidence(through[around]).max()) == 0.0


@pytest.mark.parametrize(
    ("away", "least", "moves"), [(5, 0.02, True), (5, 0.5, False), (2, 0.02, False)]
)
def test_what_is_far_off_moves_ahead_and_what_is_a_little_off_does_not(
    ahead, away, least, moves
) -> None:
    store, graph, gates = ahead(away=WALL / away)
    through = seen_through(store, graph, gates)
    assert open_though_seen_through(through, gates) > 0.02
    found = moves_ahead(store, graph, gates, least)
    assert torch.equal(found, through) if moves else found is None


def test_something_near_that_stands_is_not(ahead) -> None:
    store, graph, gates = ahead(away=WALL)
    for k in range(COUNT):
        first = round(10 - 1.25 * 0.6 * k)  # it moves by so many cells
        store.disps[k, 4:8, max(first, 0) : max(first + 5, 0)] = 0.6
    assert float(seen_through(store, graph, gates).max()) < 0.05


def test_it_is_carried_on_along_matches(ahead) -> None:
    store, graph, gates = ahead()
    before = seen_through(store, graph, gates)
    # In keyframes 5 and 6 it is as far as the wall: nothing gives it away but where it came from.
    still, kept = pixel_grid(GRID.height, GRID.width), {(5, 3), (6, 5)}
    for row, pair in enumerate(graph.pairs):
        if pair[0] in (5, 6):
            graph.target[row][THING] = still[THING]
            graph.confidence[row][THING] = float(pair in kept)
        elif pair[1] in (5, 6):
            graph.confidence[row] = 0.0
    after = seen_through(store, graph, gates)
    start = float(after[3, INNER[0], INNER[1]].min())
    assert float(before[5:7].max()) < 0.05
    assert float(after[5, INNER[0], INNER[1]].min()) == pytest.approx(0.95 * start, rel=0.02)
    assert float(after[6, INNER[0], INNER[1]].min()) == pytest.approx(0.95**2 * start, rel=0.02)
    assert float(after[7:].max()) < 0.05


@pytest.mark.parametrize("what", ["closed", "hardly known", "broken"])
def test_points_that_say_nothing_see_through_nothing(ahead, what) -> None:
    store, graph, gates = ahead()
    first = [r for r, i in enumerate(graph.ii) if i < 4]
    later = [r for r, i in enumerate(graph.ii) if i >= 4]
    if what == "closed":
        gates[:] = 0.4
        gates[:4, THING[0], THING[1]] = 1.0
    elif what == "hardly known":
        known = torch.zeros(GRID.height, GRID.width, dtype=torch.bool)
        known[:3] = known[-2:] = known[:, 12:] = True  # the larger part, and beside the thing
        graph.confidence[later] *= torch.where(known, 1.0, 0.1)[..., None]
    else:
        graph.target[later] = float("nan")
        graph.confidence[first] = float("inf")
    through = seen_through(store, graph, gates)
    assert bool(torch.isfinite(through).all())
    assert float(through.max()) < 0.05


def test_a_cell_that_is_hardly_known_may_be_anywhere(ahead) -> None:
    store, graph, gates = ahead()
    graph.confidence[:, THING[0], THING[1]] = 0.02
    assert float(seen_through(store, graph, gates).max()) < 0.05


def test_many_keyframes_are_looked_at_from_some(ahead, monkeypatch) -> None:
    monkeypatch.setattr(module, "_MOST_VIEWS", 4)
    some = seen_through(*ahead())
    assert float(some[:4, INNER[0], INNER[1]].min()) > 0.2
    monkeypatch.setattr(module, "_CHUNK", 5)
    assert torch.equal(seen_through(*ahead()), some)


def test_evidence_closes_what_is_seen_through_and_leaves_the_rest() -> None:
    through = torch.tensor([0.0, 0.1, 0.3, 0.32, 1.0])
    more = evidence(through)
    assert more[:2].tolist() == [0.0, 0.0]
    assert (gate(more) < CLOSED).tolist() == [False, False, False, True, True]
    share = open_though_seen_through(through, torch.tensor([1.0, 1.0, 1.0, 1.0, 0.1]))
    assert share == pytest.approx(0.2)


@pytest.fixture
def backend(ahead):
    """`backend(fresh=, uncertain=, **options)`: of what goes ahead, with how often it searched."""

    def make(fresh=True, uncertain=0.01, **options):
        store, *_ = ahead()
        true = store.T_cw.clone(), store.disps.clone()
        store["uncertainty"].fill_(uncertain)

        def answer(request):
            ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
            target, _ = reproject(*true, store.intrinsics, ii, jj)
            asked.append(request.gates([0])[0, INNER[0], INNER[1]].max())
            across = ((ii < 4) != (jj < 4))[:, None, None, None]
            return EdgeUpdate(target, torch.ones_like(target) * ~across)

        asked = []
        config = DroidwConfig()
        config.camera.refine_focal = False
        config.backend = replace(config.backend, passes=[1, 1], **options)
        session = SimpleNamespace(update=answer)
        parts = Parts(
            SimpleNamespace(),
            None,
            SimpleNamespace(update=lambda view: UncertaintyReport()),
            TorchBundleAdjuster(),
            SimpleNamespace(session=lambda purpose: session),
        )
        optimiser = Optimiser(store, parts, config.weighting, Stopwatch())
        return Backend(optimiser, config, fresh=fresh), asked

    return make


def test_what_is_seen_through_is_closed_and_the_passes_made_once_more(backend, caplog) -> None:
    made, asked = backend()
    with caplog.at_level(logging.INFO, "droidw"):
        assert made.run(lambda done, total: None) > 0
    assert [float(gates) > CLOSED for gates in asked] == [True, True, False, False]
    assert "backend.seen_through=1" in caplog.text
    store = made.optimiser.store
    assert float(made.optimiser.gates()[:4, INNER[0], INNER[1]].max()) < CLOSED
    weight = made.optimiser.gates()
    records = keyframe_records(store, torch.ones_like(weight, dtype=torch.bool), weight)
    said = [float(record.uncertainty[INNER].min()) for record in records]
    assert min(said[:4]) > 0.8
    assert max(said[5:]) < 0.05


@pytest.mark.parametrize(
    "options",
    [
        {"fresh": False},
        {"uncertain": 0.0},
        {"seen_through": 1.0},
        {"seen_through": 0.5},
        {"restart_below": 1.0},
    ],
    ids=["second look", "no uncertainty", "never", "not so much", "in doubt"],
)
def test_nothing_is_made_once_more(backend, options) -> None:
    made, asked = backend(**options)
    made.run(lambda done, total: None)
    assert len(asked) == 2
    assert not bool(made.optimiser.store["through"].any())


def test_what_was_added_between_is_taken_out_before_the_passes_are_made_once_more(backend) -> None:
    made, asked = backend()
    told = []
    made._between = SimpleNamespace(
        add=lambda: None,
        remove=lambda: told.append(len(asked)),
        remove_loose=lambda graph, gates: None,
        old=lambda: list(range(COUNT)),
    )
    made.run(lambda done, total: None)
    assert told == [2]
    assert len(asked) == 4


def test_the_focal_length_is_looked_for_again_from_the_given_one(backend, monkeypatch) -> None:
    made, _ = backend()
    store = made.optimiser.store
    given, started = store.image_intrinsics.clone(), []

    def refine(*args):
        started.append(store.image_intrinsics.clone())
        for intrinsics in (store.intrinsics, store.image_intrinsics):
            intrinsics[:2] *= 1.1
        return FocalSearch(1.1, ())

    monkeypatch.setattr("droidw.slam.backend.refine_focal", refine)
    made.config.camera.refine_focal = True
    made.run(lambda done, total: None)
    assert [torch.equal(start, given) for start in started] == [True, True]
    assert store.image_intrinsics[0] == pytest.approx(1.1 * float(given[0]))
    assert store.intrinsics[0] == pytest.approx(1.1 * float(given[0]) / GRID.stride)
