"""What correspondence is told of uncertainty."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.config.schema import WeightingConfig
from droidw.geometry.camera import Grid
from droidw.graph.factors import FactorGraph
from droidw.graph.store import KeyframeInfo, KeyframeStore
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.timing import Stopwatch


class Asked:
    """A session that keeps the request and measures no motion."""

    def update(self, request):
        self.request = request
        confidence = torch.ones(*request.coords.shape[:3], 2)
        return EdgeUpdate(request.coords, confidence)


def two_keyframes():
    store = KeyframeStore(Grid(6, 8, 8, 3.5), torch.tensor([60.0, 60.0, 31.5, 23.5]))
    for k, u in enumerate((0.0, 2.0)):
        blank = np.zeros((48, 64, 3), np.uint8)
        info = KeyframeInfo(k, k / 10, "", blank, None)
        pose = torch.tensor([0.1 * k, 0, 0, 0, 0, 0, 1])
        store.append(info, T_cw=pose, uncertainty=torch.full((6, 8), u))
    store["unmasked"][0, 0, 0] = 0.0
    graph = FactorGraph(6, 8)
    graph.add([(0, 1), (1, 0)])
    parts = Parts(None, None, None, None, None)
    optimiser = Optimiser(store, parts, WeightingConfig(open_share=0.0), Stopwatch())
    return optimiser, graph


@pytest.mark.parametrize("informed", [True, False])
@pytest.mark.parametrize("learned", [True, False])
def test_gates_are_given_where_geometry_and_uncertainty_count(informed, learned):
    optimiser, graph = two_keyframes()
    session = Asked()
    optimiser.measure(graph, session, graph.select(), informed, learned)
    assert session.request.informed is informed
    if not (informed and learned):
        assert session.request.gates is None
        return
    gates = session.request.gates([1, 0])
    assert gates.shape == (2, 6, 8)
    # 1 / (45 * 2 - 35) of the second keyframe; user's masks are not uncertainty
    assert gates[0].unique().tolist() == pytest.approx([1 / 55])
    assert gates[1].unique().tolist() == [1.0]


def test_half_of_a_picture_keeps_its_whole_weight_wherever_gates_are_asked():
    optimiser, graph = two_keyframes()
    optimiser.weighting = WeightingConfig()
    u = torch.linspace(1.5, 3.0, 48).reshape(6, 8)
    optimiser.store["uncertainty"][1] = u
    session = Asked()
    optimiser.measure(graph, session, graph.select(), informed=True, learned=True)
    asked = session.request.gates([1])[0], optimiser.gates()[1], optimiser.view().gate(u[None])[0]
    for gate in asked:
        assert int((gate > 0.999).sum()) == 24
        assert float(gate[-1, -1]) < 0.1
    assert int((optimiser.gates(learned=False)[1] == 1.0).sum()) == 48


def test_what_moves_has_no_weight_at_all_once_learned_anew():
    optimiser, _ = two_keyframes()
    assert optimiser.gates()[1].unique().tolist() == pytest.approx([1 / 55])
    optimiser.anew = True
    asked = (
        optimiser.gates()[1],
        optimiser.learned_gates([1]),
        optimiser.view().gate(optimiser.store["uncertainty"][1]),
    )
    assert [gates.unique().tolist() for gates in asked] == [[0.0]] * 3
    assert int((optimiser.gates()[0] == 1.0).sum()) == 47  # and what stands still keeps all of it
    optimiser.weighting = WeightingConfig(open_share=0.0, closed_below=0.0)
    assert optimiser.gates()[1].unique().tolist() == pytest.approx([1 / 55])


@pytest.mark.parametrize(("late", "share"), [(0.3, 0.3), (0.5, 0.5), (0.9, 0.5)])
def test_more_of_a_picture_may_close_once_it_is_known_better(late, share):
    optimiser, _ = two_keyframes()
    uncertainty = optimiser.store["uncertainty"]
    uncertainty[:] = torch.linspace(0.9, 2.0, uncertainty[0].numel()).reshape(uncertainty[0].shape)
    optimiser.weighting = WeightingConfig(open_late=late)

    def open_():
        return float((optimiser.gates() == 1.0).float().mean())

    assert open_() == pytest.approx(0.5, abs=0.03)
    optimiser.anew = True
    assert open_() == pytest.approx(share, abs=0.03)


class Moving:
    """Features that say what can move, and a model that begins with it."""

    begins = True

    def movable(self, image, grid):
        raise AssertionError("not asked here")

    def begin(self, view, movable):
        assert list(view.indices().frames) == [0, 1]
        view.uncertainty[:] = 2 * movable


def test_what_can_move_is_known_before_the_first_search():
    optimiser, graph = two_keyframes()
    optimiser.parts = Parts(Moving(), None, Moving(), None, None)
    optimiser.begin()
    assert not optimiser.begun  # asked of the parts that it was built with
    both = Optimiser(optimiser.store, optimiser.parts, WeightingConfig(open_share=0.0), Stopwatch())
    both.store["movable"][1] = 1.0
    both.begin()
    assert both.begun
    session = Asked()
    both.measure(graph, session, graph.select(), informed=False, learned=True)
    gates = session.request.gates([0, 1])
    assert gates[0].unique().tolist() == [1.0]
    assert gates[1].unique().tolist() == pytest.approx([1 / 55])
    both.measure(graph, session, graph.select(), informed=False, learned=False)
    assert session.request.gates is None
