"""What becomes of a path in doubt: tracked from the last keyframe to the first; what is kept."""

from __future__ import annotations

import math

import pytest
import torch

from droidw.events import Dispatcher, Progress
from droidw.slam import backwards as module
from droidw.slam.backwards import doubted
from droidw.slam.doubt import Link


class Heard:
    """Keeps all events."""

    def __init__(self):
        self.events = []

    def on_event(self, event):
        self.events.append(event)


@pytest.mark.parametrize("found", [0.5, 0.4, float("nan"), None, RuntimeError("no memory")])
def test_what_was_found_first_stays_unless_more_agrees(optimiser, found, settled):
    before = optimiser.store.T_cw.clone()
    made = settled(found)
    assert made.asked == 1
    assert (made.kept.agreement, made.kept.backwards) == (0.5, 0.0)
    assert torch.equal(optimiser.store.T_cw, before)
    assert any("no memory" in text for text in made.events.warnings) == isinstance(found, Exception)
    # It has been measured as what is in doubt is, so there is something to learn from.
    assert made.learned == ([True, True] if isinstance(found, float) else [])


def test_both_ways_are_compared_as_they_agree_when_measured_alike(optimiser, settled):
    made = settled(0.45, again=0.4)
    assert (made.kept.agreement, made.kept.backwards) == (0.45, 1.0)
    assert torch.equal(optimiser.store.T_cw, made.found.T_cw)


def test_nothing_is_kept_of_a_look_that_found_no_way_back(settled):
    made = settled(None, again=0.4)
    assert (made.kept.agreement, made.kept.backwards) == (0.5, 0.0)


def test_the_way_back_is_kept_where_more_agrees_and_learned_from(optimiser, settled):
    made = settled(0.6)
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert torch.equal(optimiser.store.T_cw, made.found.T_cw)
    assert made.learned == [True, True]


@pytest.mark.parametrize(("found", "share"), [(0.6, 1 - 4 / 13), (0.4, 4 / 13)])
def test_pieces_of_the_way_that_agrees_less_are_taken(config, found, share, settled):
    config.backend.passes = [1, 2, 3, 4]
    made = settled(found, piece=range(3, 7))
    assert (made.kept.agreement, made.kept.backwards) == (0.7, pytest.approx(share))
    assert made.learned == [False, True, True]
    few = [(2, "usual"), (3, "narrow"), (4, "narrowest")]
    again = [(1, "usual"), (2, "narrow"), (3, "narrowest"), (4, "narrowest")]
    assert (made.there, made.passes) == (few, [few, again, again])
    # what was taken for its matches is not to be drawn to a steady path before it is weighed
    assert made.priors == [0.0, config.backend.motion_prior, config.backend.motion_prior]


def test_pieces_that_global_adjustment_leaves_are_not_kept(optimiser, settled):
    before = optimiser.store.T_cw.clone()
    made = settled(0.4, piece=range(3, 7), holds=False)
    assert (made.kept.agreement, made.kept.backwards) == (0.5, 0.0)
    assert torch.equal(optimiser.store.T_cw, before)
    assert made.learned == [False, True, True]


@pytest.mark.parametrize("turns", [1, 3])
@pytest.mark.parametrize(("learn", "prior"), [(True, 0.0), (False, 30.0), (True, 30.0)])
def test_learning_and_steady_motion_share_adjustments(config, learn, prior, turns, settled):
    config.backend.turns = turns
    config.backend.relearn, config.backend.motion_prior = learn, prior
    made = settled(0.6)
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert (made.learned, made.priors) == (turns * [learn], turns * [prior])


@pytest.mark.parametrize(
    ("beyond", "begun"),
    [
        (2.0, [1.0, 0.5, -0.25, -0.125, -0.0625]),
        (1.0, [1.0, 0.5, 0.0, 0.0, 0.0]),
        (0.0, [1.0, 0.5, 0.25, 0.125, 0.0625]),
    ],
)
def test_after_two_turns_the_next_sets_out_beyond_them(config, beyond, begun, settled):
    config.backend.turns, config.backend.beyond = 5, beyond
    made = settled(0.6, mark=math.e, halves=True)
    assert made.begun == pytest.approx(begun, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(("below", "turns"), [(0.65, 1), (0.55, 4)])
def test_one_turn_is_enough_for_what_is_tracked_once_more(config, below, turns, settled):
    config.backend.turns, config.frontend.again_below = 4, below
    made = settled(0.6)
    assert made.learned == turns * [True]


def test_nothing_is_done_that_is_not_asked_for(config, settled):
    config.backend.splice = config.backend.relearn = False
    config.backend.motion_prior = 0.0
    made = settled(0.6, piece=range(3, 7))
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert made.learned == []
    assert made.compared == 0


@pytest.mark.parametrize("piece", [(), range(3, 7)])
def test_what_fails_after_the_way_back_leaves_it(optimiser, piece, settled):
    failure = RuntimeError("no memory")
    made = settled(0.6, piece=piece, adjusted=failure)
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert torch.equal(optimiser.store.T_cw, made.found.T_cw)
    assert any("no memory" in text for text in made.events.warnings)


@pytest.mark.parametrize("piece", [(), range(3, 7)])
def test_a_run_that_is_to_end_keeps_the_best_so_far(optimiser, piece, settled):
    made = settled(0.6, piece=piece, stopped=True)
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert torch.equal(optimiser.store.T_cw, made.found.T_cw)
    assert torch.equal(optimiser.store.disps, made.found.disps)
    assert made.events.warnings == []
    assert len(made.learned) == 1  # given up in the first that was begun


@pytest.mark.parametrize(
    ("below", "agreement", "asked"),
    [(0.7, 0.69, 1), (0.7, 0.7, 0), (0.0, 0.0, 0), (1.0, 1.0, 1), (0.7, float("nan"), 0)],
)
def test_only_doubt_asks_for_it(config, below, agreement, asked, settled):
    config.backend.backwards_below = below
    assert settled(None, agreement).asked == asked


@pytest.mark.parametrize(
    ("link", "below", "asked"), [(0.14, 0.15, 1), (0.16, 0.15, 0), (0.0, 0.0, 0)]
)
def test_a_broken_path_is_in_doubt_however_much_agrees(config, caplog, link, below, asked, settled):
    config.backend.backwards_below, config.backend.broken_below = 0.7, below
    with caplog.at_level("INFO", "droidw"):
        made = settled(None, 0.9, links=(link, 0.5, 0.5))
    assert made.asked == asked
    assert ("across frame 7" in caplog.text) == bool(asked)
    assert (made.kept.weakest, made.kept.broken) == (Link(link, 7), bool(asked))
    assert any("broken there" in said for said in made.kept.warnings()) == bool(asked)


@pytest.mark.parametrize(
    ("links", "found", "back"),
    [
        ((0.1, 0.1, 0.4), 0.4, True),  # less agrees, but it hangs together
        ((0.1, 0.4, 0.1), 0.6, False),
        ((0.1, 0.1, 0.05), 0.6, True),  # both have broken
    ],
)
def test_a_way_that_has_not_broken_is_kept(config, links, found, back, settled):
    config.backend.relearn, config.backend.motion_prior = False, 0.0
    made = settled(found, links=links)
    assert made.kept.backwards == float(back)
    assert made.kept.weakest.share == links[2 if back else 1]
    assert made.kept.broken == (made.kept.weakest.share < config.backend.broken_below)


@pytest.mark.parametrize("fails", [False, True])
def test_correspondence_is_told_of_the_doubt_while_it_lasts(
    optimiser, config, monkeypatch, fails, diagnosis
):
    asked = []
    session = optimiser.parts.correspondence.session("window")
    monkeypatch.setattr(
        session, "update", lambda r, update=session.update: asked.append(r.doubtful) or update(r)
    )
    if fails:
        monkeypatch.setattr(module._SecondLook, "_finish", lambda self: 1 / 0)
    doubted(optimiser, config, diagnosis(0.5), Dispatcher(), lambda: False)
    assert asked and all(asked)
    assert not optimiser.doubtful


@pytest.mark.parametrize("splice", [True, False])
def test_it_is_told_how_far_it_is(optimiser, config, splice, diagnosis):
    heard = Heard()
    config.backend.relearn, config.backend.splice = False, splice
    config.backend.motion_prior = 0.0
    doubted(optimiser, config, diagnosis(0.5), Dispatcher([("heard", heard)]), lambda: False)
    told = [(event.done, event.total) for event in heard.events]
    count = len(optimiser.store)
    total = count + 2 * (2 + splice)
    steps = [1, 2, *range(2, 2 + count), count + 3, count + 4]
    assert told[: count + 4] == [(k, total) for k in steps]
    assert told[-1] == (total, total)
    assert all(isinstance(event, Progress) for event in heard.events)
