"""Pieces of a path in doubt that points contradict set out anew, and points count while it ends."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from droidw.events import Dispatcher
from droidw.geometry.se3 import exp, mul
from droidw.slam import backwards as module
from droidw.slam.backwards import doubted


class Points:
    """Stand-ins for points that contradict the path in a piece.

    Args:
        count: of all keyframes.
        gains: what `credit` says of the intervals of the piece, once for each path that is asked
            about.
    """

    def __init__(self, monkeypatch, count, gains, piece=range(3, 7)):
        self.count, self.gains, self.piece, self.set = count, list(gains), piece, 0
        monkeypatch.setattr(module, "matched_points", lambda optimiser: "points")
        monkeypatch.setattr(module, "contradicted", lambda *_: dict.fromkeys(piece))
        monkeypatch.setattr(module, "set_out", self.set_out)
        monkeypatch.setattr(module, "credit", self.credit)

    def set_out(self, optimiser, config, path, motions):
        self.set += 1
        k = torch.arange(float(self.count))[:, None]
        turn = exp(k * torch.tensor([0.0, 0.0, 0.0, 0.02, 0.0, 0.0]))
        return replace(path, T_cw=mul(turn, path.T_cw))

    def credit(self, paths, supports, matches):
        assert matches == "points"
        gained = torch.zeros(self.count - 1, dtype=torch.float64)
        gained[list(self.piece)] = self.gains.pop(0)
        return gained


@pytest.fixture
def contradicting(optimiser, monkeypatch):
    """`contradicting(gains)`: points that contradict the path, see `Points`."""
    return lambda gains: Points(monkeypatch, len(optimiser.store), gains)


@pytest.mark.parametrize(
    ("gains", "kept"), [([1.0, 0.5], True), ([1.0, -0.5], False), ([0.1], False)]
)
def test_pieces_that_points_contradict_set_out_anew(
    optimiser, config, gains, kept, settled, contradicting
):
    config.backend.turns = config.backend.restarts = 1
    points = contradicting(gains)
    made = settled(0.6)
    assert (points.set, points.gains) == (1, [])
    # The first adjustment is of what sets out, the second of the pieces that are taken.
    assert made.learned == (len(gains) * [False]) + [True]
    assert made.priors[:-1] == len(gains) * [0.0]
    assert torch.allclose(optimiser.store.T_cw, made.found.T_cw) != kept
    assert made.kept.agreement == 0.6


def test_pieces_set_out_before_each_of_the_first_turns(config, settled, contradicting):
    config.backend.turns, config.backend.restarts = 4, 2
    points = contradicting([0.1, 0.1])
    made = settled(0.6)
    assert points.set == 2
    assert made.learned == [False, True, False, True, True, True]


@pytest.mark.parametrize(("restarts", "begun"), [(2, -0.5), (3, 0.25)])
def test_what_has_set_out_anew_is_not_led_beyond(
    optimiser, config, monkeypatch, restarts, begun, settled
):
    config.backend.turns, config.backend.restarts, config.backend.beyond = 3, restarts, 3.0
    asked = iter([False, False, True])
    monkeypatch.setattr(module, "matched_points", lambda optimiser: "points")
    monkeypatch.setattr(module._SecondLook, "_restart", lambda self, matches: next(asked))
    made = settled(0.6, mark=math.e, halves=True)
    assert made.begun == pytest.approx([1.0, 0.5, begun], rel=1e-5)


@pytest.mark.parametrize(("found", "weight"), [("points", 7.0), ("points", 0.0), (None, 7.0)])
def test_points_count_while_it_finishes(optimiser, config, monkeypatch, found, weight, settled):
    config.backend.points, config.backend.restarts = weight, 0
    monkeypatch.setattr(module, "matched_points", lambda optimiser: found)
    made = settled(0.6)
    heard = (found, weight) if found and weight else None
    assert made.points == [heard] * config.backend.turns
    assert optimiser.points is None


def test_points_of_a_turn_are_those_that_are_matched_then(optimiser, config, monkeypatch, settled):
    config.backend.restarts, config.backend.turns = 0, 3
    matched = iter(["some", None, "others"])
    monkeypatch.setattr(module, "matched_points", lambda optimiser: next(matched))
    made = settled(0.6)
    weight = config.backend.points
    assert made.points == [("some", weight), None, ("others", weight)]


def test_points_are_forgotten_where_it_breaks_off(optimiser, monkeypatch, settled):
    monkeypatch.setattr(module, "matched_points", lambda optimiser: "points")
    made = settled(0.6, adjusted=RuntimeError("no memory"))
    assert made.events.warnings
    assert optimiser.points is None


def test_restarts_are_left_out_where_they_are_not_asked_for(config, settled, contradicting):
    config.backend.restarts = 0
    points = contradicting([])
    made = settled(0.6)
    assert points.set == 0
    assert made.learned == [True, True]


# Of a path that points contradict, agreement is what the wrong path makes of it.
@pytest.mark.parametrize(("left", "asked"), [(0.69, 1), (0.72, 0)])
def test_what_sets_out_anew_is_what_is_doubted(
    optimiser, config, left, asked, settled, contradicting
):
    config.backend.backwards_below, config.backend.turns = 0.7, 0
    before = optimiser.store.T_cw.clone()
    points = contradicting([1.0, 0.5])
    made = settled(None, 0.75, again=left)
    assert (points.set, made.asked, points.gains) == (1, asked, [])
    assert made.kept.agreement == left
    assert made.kept.backwards == 0.0
    assert not torch.allclose(optimiser.store.T_cw, before)
    assert optimiser.points is None
    assert not optimiser.doubtful


def test_what_points_gain_nothing_by_is_left_as_it_was(optimiser, config, settled, contradicting):
    config.backend.backwards_below = 0.7
    before = optimiser.store.T_cw.clone()
    points = contradicting([0.1])
    made = settled(None, 0.75, again=0.5)
    assert (points.set, made.asked, made.kept.agreement) == (1, 0, 0.75)
    assert torch.equal(optimiser.store.T_cw, before)


@pytest.mark.parametrize(
    ("below", "agreement", "asked"),
    [(0.8, 0.79, 1), (0.8, 0.8, 0), (0.0, 0.71, 0), (1.0, 1.0, 1), (0.8, float("nan"), 0)],
)
def test_points_are_asked_where_not_quite_enough_agrees(
    config, below, agreement, asked, settled, contradicting
):
    config.backend.backwards_below, config.backend.restart_below = 0.7, below
    points = contradicting([0.1])
    made = settled(None, agreement)
    assert (points.set, made.asked) == (asked, 0)


def test_points_count_while_pieces_set_out_first(
    optimiser, config, monkeypatch, contradicting, diagnosis
):
    config.backend.backwards_below, config.backend.points = 0.7, 3.0
    counted = []

    def run(backend, tell):
        counted.append(backend.optimiser.points)
        backend.agreement = 0.75

    contradicting([1.0, 0.5])
    monkeypatch.setattr(module.Backend, "run", run)
    monkeypatch.setattr(
        module, "support", lambda *_: torch.ones(len(optimiser.store) - 1, dtype=torch.float64)
    )
    doubted(optimiser, config, diagnosis(0.75), Dispatcher(), lambda: False)
    assert counted == [("points", 3.0)] * 2
