"""Whether footage is tracked a second time, what is hidden then, and which outcome is kept."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from droidw.config.schema import DroidwConfig, FrontendConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.graph.factors import FactorGraph
from droidw.run.again import Again, Hidden, again, second_time
from droidw.slam.diagnosis import Diagnosis
from droidw.slam.doubt import doubtful


def outcome(agreement, frames=30, open_=1.0, still=False):
    """What tracking came to; so much of its only keyframe is open, from the left."""
    diagnosis = Diagnosis(frames, 3, still=still, lost=0.0, agreement=agreement)
    weight = np.zeros((10, 20), np.float32)
    weight[:, : int(20 * open_)] = 1.0
    record = SimpleNamespace(weight=weight)
    return SimpleNamespace(diagnosis=diagnosis, trajectory=range(frames), keyframes=(record,))


def to_hide(system, outcome, below):
    """What is hidden for doubt."""
    found = again(system, outcome, FrontendConfig(again_below=below, unknown_moves=1.0))
    assert found is None or not found.turned
    return found and found.hidden


def rejection(first, second, turned=False):
    return Again(Hidden([], []), turned, "").rejection(first, second)


class Named:
    """Fields that can be asked for by name, too."""

    def __getitem__(self, name):
        return getattr(self, name)


class Fields(Named, SimpleNamespace):
    """What a store holds of all keyframes."""


class Store(Named, list):
    """Infos of keyframes, as a store has them, and what can move."""

    movable = torch.zeros(3, 12, 16)

    @property
    def infos(self):
        return list(self)


@pytest.fixture
def first():
    """A system of three keyframes, of which uncertainty closes the left half of two."""
    gates = torch.ones(3, 12, 16)
    gates[:2, :, :8] = 0.1
    return SimpleNamespace(
        store=Store(SimpleNamespace(index=index) for index in (4, 7, 9)),
        grid=Grid(12, 16, 8, 3.5),
        camera=SimpleNamespace(width=128, height=96),
        optimiser=SimpleNamespace(
            learned_gates=lambda nodes: gates[list(nodes)],
            upright=SimpleNamespace(doubts=doubtful),
        ),
        gates=gates,
    )


def test_less_is_doubted_where_lines_count(first):
    first.optimiser.upright.doubts = lambda agreement, below: agreement < 0.5 * below
    assert to_hide(first, outcome(0.4), below=0.7) is None
    assert to_hide(first, outcome(0.3), below=0.7)


def test_what_uncertainty_closes_is_hidden(first):
    hidden = to_hide(first, outcome(0.5), below=0.7)
    for index in (4, 7):
        assert hidden(index).shape == (96, 128)
        assert hidden(index)[:, :56].all()
        assert not hidden(index)[:, 72:].any()
    assert hidden(9) is None


def test_between_keyframes_what_either_hides_is_hidden():
    left, right, nothing = (np.zeros((6, 8), bool) for _ in range(3))
    left[:, :3], right[:, 5:] = True, True
    hidden = Hidden([2, 6, 9], [left, right, nothing])
    assert (hidden(2) == left).all()
    assert (hidden(4) == (left | right)).all()
    assert (hidden(6) == right).all()
    assert (hidden(8) == right).all()
    assert hidden(9) is None
    assert hidden(12) is None
    assert (hidden(0) == left).all()
    assert hidden.share == pytest.approx((3 / 8 + 3 / 8) / 3)


@pytest.mark.parametrize("agreement", [0.7, 0.9, float("nan")])
def test_without_doubt_nothing_is_hidden(first, agreement):
    assert to_hide(first, outcome(agreement), below=0.7) is None


def test_one_doubts_all_and_zero_nothing(first):
    assert to_hide(first, outcome(1.0), below=1.0)
    assert to_hide(first, outcome(0.0), below=0.0) is None


def test_a_little_is_not_worth_the_time(first):
    first.gates[:] = 1.0
    first.gates[0, :2, :2] = 0.0
    assert to_hide(first, outcome(0.5), below=0.7) is None


def test_the_second_outcome_stays_unless_it_agrees_much_less_or_is_shorter():
    assert rejection(outcome(0.60), outcome(0.70)) == ""
    assert rejection(outcome(0.60), outcome(0.58)) == ""
    assert "50 %" in rejection(outcome(0.60), outcome(0.50))
    assert rejection(outcome(0.60), outcome(float("nan")))
    assert "18 of 26 frames" in rejection(outcome(0.60, 26), outcome(0.70, 18))


def turned(system, above, known=0.0, still=False):
    """What is tracked again because so much moves that nobody knows to."""
    system.store.movable = torch.full((3, 12, 16), known)
    return again(system, outcome(0.9, still=still), FrontendConfig(unknown_moves=above))


def test_where_much_moves_that_nobody_knows_to_the_rest_is_hidden(first):
    found = turned(first, above=0.3)  # a third of all cells is closed
    assert found.turned
    assert "33 %" in found.why and "frontend.unknown_moves" in found.why
    for index in (4, 7):
        assert not found.hidden(index)[:, :56].any()
        assert found.hidden(index)[:, 72:].all()
    assert found.hidden(9).all()


def test_what_is_known_to_move_is_not_taken_for_the_world(first):
    assert turned(first, above=0.3, known=0.2) is None
    assert turned(first, above=0.4) is None
    assert turned(first, above=1.0) is None


def test_of_a_camera_at_rest_nothing_else_is_the_world(first):
    assert turned(first, above=0.1, still=True) is None


@pytest.fixture
def second():
    """What has been tracked of a plane by a camera that went aside; half of it is seen."""
    store = Fields(
        T_cw=torch.tensor([[0.0, 0, 0, 0, 0, 0, 1], [-0.5, 0, 0, 0, 0, 0, 1]]),
        disps=torch.ones(2, 10, 20),
        unmasked=torch.zeros(2, 10, 20),
        intrinsics=torch.tensor([16.0, 16, 10, 5]),
    )
    graph = FactorGraph(10, 20)
    rows = graph.add([(0, 1)])
    ahead, _ = reproject(store.T_cw, store.disps, store.intrinsics, *graph.index(rows))
    graph.record(rows, ahead, torch.ones_like(ahead))
    store.unmasked[:, :, 5:15] = 1.0
    gates = store.unmasked.clone()
    return SimpleNamespace(
        store=store,
        frontend=SimpleNamespace(graph=graph),
        optimiser=SimpleNamespace(gates=lambda: gates),
        gates=gates,
    )


def unfounded(system, turned=True):
    return Again(Hidden([], []), turned, "").unfounded(system)


def test_what_is_tracked_of_another_world_has_to_hold_together(second):
    assert unfounded(second) == ""
    second.frontend.graph.target += 3.0  # cells, from where its poses say
    assert "0 % of what was seen" in unfounded(second)


def test_another_world_that_uncertainty_closes_as_well_is_none(second):
    second.gates[:, :, 7:] = 0.0
    assert "20 % of what was seen" in unfounded(second)
    assert unfounded(second, turned=False) == ""


def test_another_world_of_which_nothing_is_seen_is_none(second):
    second.store.unmasked[:] = second.gates[:] = 0.0
    assert unfounded(second)


def test_without_a_keyframe_there_is_nothing_to_hide(first):
    first.store.clear()
    first.optimiser.learned_gates = None
    assert again(first, outcome(float("nan"), still=True), FrontendConfig()) is None


def test_doubt_comes_before_another_world(first):
    found = again(first, outcome(0.5), FrontendConfig(again_below=0.7, unknown_moves=0.1))
    assert not found.turned
    assert "frontend.again_below" in found.why


def test_another_world_has_to_reach_farther():
    first = outcome(0.95, open_=0.5)
    assert rejection(first, outcome(0.90, open_=0.7), turned=True) == ""
    assert "0.08" in rejection(first, outcome(0.95, open_=0.3), turned=True)
    assert rejection(first, outcome(0.6, open_=0.6), turned=True)
    assert rejection(first, outcome(0.95, open_=0.5), turned=True)
    assert rejection(first, outcome(float("nan"), open_=0.7), turned=True)
    assert "18 of 30 frames" in rejection(first, outcome(0.9, 18, open_=0.7), turned=True)


def test_what_surrounds_a_mover_reaches_farther_than_it():
    around, inside = outcome(0.9), outcome(0.9)
    around.keyframes[0].weight[3:7, 4:16] = 0.0  # a quarter of the picture, in its middle
    inside.keyframes[0].weight[:] = 0.0
    inside.keyframes[0].weight[2:8, 3:17] = 1.0
    assert rejection(inside, around, turned=True) == ""
    assert rejection(around, inside, turned=True)


def test_there_is_no_third_time():
    config = DroidwConfig()
    second = second_time(config)
    assert second.frontend.again_below == 0.0
    assert second.frontend.unknown_moves == 1.0
    assert config.frontend.again_below > 0.0
    assert second.backend is config.backend
