"""Keyframes tracked from the last to the first, and when that is kept."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import BackendConfig, CameraConfig, DroidwConfig
from droidw.events import Dispatcher, Progress
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import exp, inv, mul
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam import backwards as module
from droidw.slam.backwards import doubted, track_backwards
from droidw.slam.diagnosis import Diagnosis
from droidw.slam.doubt import Link
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.path import Path
from droidw.slam.timing import Stopwatch
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

H, W, COUNT, WARM = 8, 12, 14, 4
GRID, INTRINSICS = Grid(H, W, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5])


def relative(T_cw):
    """Every pose seen from the first one, [N,7]."""
    return mul(T_cw, inv(T_cw[:1]).expand_as(T_cw))


@pytest.fixture
def truth(arc, waves):
    """Poses and disparities of all keyframes."""
    return arc(COUNT), waves(COUNT, H, W)


@pytest.fixture
def optimiser(truth, stored):
    """Of a run that measures exactly; its last poses are right, those before are astray."""
    T_cw, disps = truth

    def measured(request):
        # The store of the way back holds keyframes in another order: `index` tells them apart.
        index = torch.tensor([request.payload(k) for k in range(1 + max(request.ii + request.jj))])
        ii, jj = index[torch.tensor(request.ii)], index[torch.tensor(request.jj)]
        target, valid = reproject(T_cw, disps, GRID.intrinsics(INTRINSICS), ii, jj)
        return EdgeUpdate(target, valid[..., None].float().expand_as(target).contiguous())

    session = SimpleNamespace(update=measured, forget=lambda ids: None)
    operator = SimpleNamespace(session=lambda _: session)
    parts = Parts(None, None, None, TorchBundleAdjuster(), operator)
    off = exp(torch.tensor([0.1, -0.05, 0.0, 0.05, 0.1, 0.05])).expand(COUNT - WARM, -1)
    astray = torch.cat([mul(off, T_cw[: COUNT - WARM]), T_cw[COUNT - WARM :]])
    store = stored(GRID, INTRINSICS.clone(), astray, disps)
    for k, info in enumerate(store.infos):
        info.payload = k
    return Optimiser(store, parts, DroidwConfig().weighting, Stopwatch())


@pytest.fixture
def config():
    """Of a run that doubts all; uncertainty does not learn here, as there is none."""
    made = DroidwConfig(camera=CameraConfig(refine_focal=False))
    made.frontend = replace(made.frontend, warmup=WARM, again_below=0.0)
    made.backend = BackendConfig(passes=[1, 1], backwards_below=1.0, turns=2)
    return made


def track(optimiser, config, stopped=lambda: False):
    told = []
    back = track_backwards(optimiser, config, lambda *news: told.append(news), stopped)
    return back, told


def test_the_way_back_finds_what_the_way_there_lost(optimiser, config, truth):
    before = optimiser.store.T_cw.clone()
    back, told = track(optimiser, config)
    assert torch.equal(optimiser.store.T_cw, before)
    assert torch.allclose(back.T_cw[0], before[0], atol=1e-6)
    assert back.agreement > 0.99
    back.write_to(optimiser.store)
    found, right = relative(optimiser.store.T_cw), relative(truth[0])
    # Monocular: all but the scale.
    scale = (found[:, :3] * right[:, :3]).sum() / right[:, :3].square().sum()
    assert torch.allclose(found[:, :3] / scale, right[:, :3], atol=5e-3)
    assert torch.allclose(found[:, 3:], right[:, 3:], atol=5e-3)
    assert told == [(k, COUNT + 2) for k in range(COUNT)] + [(COUNT + k, COUNT + 2) for k in (1, 2)]


def test_all_but_the_path_stays(optimiser, config):
    store = optimiser.store
    known = 0.01 * torch.arange(1.0, 1 + COUNT)[:, None, None].expand(COUNT, H, W)
    store["uncertainty"].copy_(known)
    first, times = store.T_cw[0].clone(), store.times()
    back, _ = track(optimiser, config)
    back.write_to(store)
    assert torch.allclose(store.T_cw[0], first, atol=1e-6)
    assert store.times() == times
    assert [info.index for info in store.infos] == list(range(COUNT))
    assert torch.equal(store["uncertainty"], known)


@pytest.mark.parametrize("after", [0, WARM - 1, COUNT - 1, COUNT, COUNT + 1])
def test_a_run_that_is_to_end_gives_it_up(optimiser, config, after):
    asked = iter(range(COUNT + 3))
    back, told = track(optimiser, config, lambda: next(asked) >= after)
    assert back is None
    assert len(told) == after


def test_too_few_keyframes_are_left_alone(optimiser, config):
    config.frontend.warmup = COUNT
    assert track(optimiser, config) == (None, [])


class Heard:
    """Keeps all events."""

    def __init__(self):
        self.events = []

    def on_event(self, event):
        self.events.append(event)


def bent(store, agreement, mark=1.0):
    """Another path of the keyframes; `mark` of it is in its depths."""
    k = torch.arange(float(len(store)))[:, None]
    bend = exp(k * torch.tensor([0.0, 0.1, 0.0, 0.0, 0.0, 0.01]))
    made = Path.of(store, agreement)
    return replace(made, T_cw=mul(bend, store.T_cw), disps=torch.full_like(made.disps, mark))


class Settled:
    """What `doubted` makes of a way back.

    Args:
        found: agreement of the way back; None if it was given up, or what it fails with.
        piece: intervals of the other way that agree more, and whether they hold.
        again: agreement of the way there, measured once more before both are compared.
        adjusted: agreement after each further global adjustment, or what it fails with.
        stopped: whether the run is to end, once the way back is found.
        links: where the run, the way there measured once more, and the way back hang together
            least.
        mark: of the depths of the way back. halves: whether further adjustments halve what all
            inverse depths are off 1, in logarithms.
    Attributes:
        learned: for each global adjustment after the way back, whether uncertainty was to learn.
        passes: updates and kernel of each of these, none with the wide one.
        priors: how much steady motion counted in each of these.
        points: matches of points that counted in each of these, and how much.
        begun: mean logarithm of the inverse depths from which each of these set out.
    """

    def __init__(self, optimiser, config, monkeypatch, found, agreement=0.5, **more):
        self.asked, self.learned, self.passes, self.compared = 0, [], [], 0
        self.priors, self.begun, self.points = [], [], []
        self.more = {"piece": (), "holds": True, "again": agreement, "adjusted": 0.7} | more
        self.links = [Link(share, 7) for share in self.more.get("links", (0.5, 0.5, 0.5))]
        mark = self.more.get("mark", 1.0)
        self.found = found
        if isinstance(found, float):
            self.found = replace(bent(optimiser.store, found, mark), weakest=self.links[2])
        monkeypatch.setattr(module, "track_backwards", self.track)
        monkeypatch.setattr(module, "support", self.support)
        monkeypatch.setattr(module.Backend, "run", lambda backend, tell: self.adjust(backend, tell))
        self.events = Dispatcher()
        diagnosis = Diagnosis(
            COUNT, COUNT, still=False, lost=0.0, agreement=agreement, weakest=self.links[0]
        )
        stopped = self.more.get("stopped", False)
        self.kept = doubted(
            optimiser, config, diagnosis, self.events, lambda: stopped and self.asked > 0
        )

    def track(self, *arguments):
        self.asked += 1
        if isinstance(self.found, Exception):
            raise self.found
        return self.found

    def support(self, optimiser, path):
        """Asked of the path that is kept, of the other one, and of what was made of both."""
        self.compared += 1
        between = torch.ones(COUNT - 1, dtype=torch.float64)
        if self.compared > 1:
            better = self.compared == 2 or self.more["holds"]
            between[list(self.more["piece"])] *= 3.0 if better else 0.5
        return between

    def adjust(self, backend, tell):
        made = [(part.updates, part.kernel) for part in backend.passes]
        if not self.asked:
            assert not backend.config.schedule["global"].learn
            self.there = made
            backend.agreement, backend.weakest = self.more["again"], self.links[1]
            return
        self.passes.append(made)
        self.learned.append(backend.config.schedule["global"].learn)
        self.priors.append(backend.motion_prior)
        self.points.append(backend.optimiser.points)
        disps = backend.optimiser.store.disps
        self.begun.append(float(disps.log().mean()))
        if self.more.get("halves"):
            disps.sqrt_()
        if isinstance(self.more["adjusted"], Exception):
            raise self.more["adjusted"]
        for done in (1, 2):
            tell(done, 2)
        backend.agreement = self.more["adjusted"]


@pytest.mark.parametrize("found", [0.5, 0.4, float("nan"), None, RuntimeError("no memory")])
def test_what_was_found_first_stays_unless_more_agrees(optimiser, config, monkeypatch, found):
    before = optimiser.store.T_cw.clone()
    made = Settled(optimiser, config, monkeypatch, found)
    assert made.asked == 1
    assert (made.kept.agreement, made.kept.backwards) == (0.5, 0.0)
    assert torch.equal(optimiser.store.T_cw, before)
    assert any("no memory" in text for text in made.events.warnings) == isinstance(found, Exception)
    # It has been measured as what is in doubt is, so there is something to learn from.
    assert made.learned == ([True, True] if isinstance(found, float) else [])


def test_both_ways_are_compared_as_they_agree_when_measured_alike(optimiser, config, monkeypatch):
    other = bent(optimiser.store, 0.45)
    made = Settled(optimiser, config, monkeypatch, 0.45, again=0.4)
    assert (made.kept.agreement, made.kept.backwards) == (0.45, 1.0)
    assert torch.equal(optimiser.store.T_cw, other.T_cw)


def test_nothing_is_kept_of_a_look_that_found_no_way_back(optimiser, config, monkeypatch):
    made = Settled(optimiser, config, monkeypatch, None, again=0.4)
    assert (made.kept.agreement, made.kept.backwards) == (0.5, 0.0)


def test_the_way_back_is_kept_where_more_agrees_and_learned_from(optimiser, config, monkeypatch):
    other = bent(optimiser.store, 0.6)
    made = Settled(optimiser, config, monkeypatch, 0.6)
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert torch.equal(optimiser.store.T_cw, other.T_cw)
    assert made.learned == [True, True]


@pytest.mark.parametrize(("found", "share"), [(0.6, 1 - 4 / 13), (0.4, 4 / 13)])
def test_pieces_of_the_way_that_agrees_less_are_taken(optimiser, config, monkeypatch, found, share):
    config.backend.passes = [1, 2, 3, 4]
    made = Settled(optimiser, config, monkeypatch, found, piece=range(3, 7))
    assert (made.kept.agreement, made.kept.backwards) == (0.7, pytest.approx(share))
    assert made.learned == [False, True, True]
    few = [(2, "usual"), (3, "narrow"), (4, "narrowest")]
    again = [(1, "usual"), (2, "narrow"), (3, "narrowest"), (4, "narrowest")]
    assert (made.there, made.passes) == (few, [few, again, again])
    # what was taken for its matches is not to be drawn to a steady path before it is weighed
    assert made.priors == [0.0, config.backend.motion_prior, config.backend.motion_prior]


def test_pieces_that_global_adjustment_leaves_are_not_kept(optimiser, config, monkeypatch):
    before = optimiser.store.T_cw.clone()
    made = Settled(optimiser, config, monkeypatch, 0.4, piece=range(3, 7), holds=False)
    assert (made.kept.agreement, made.kept.backwards) == (0.5, 0.0)
    assert torch.equal(optimiser.store.T_cw, before)
    assert made.learned == [False, True, True]


@pytest.mark.parametrize("turns", [1, 3])
@pytest.mark.parametrize(("learn", "prior"), [(True, 0.0), (False, 30.0), (True, 30.0)])
def test_learning_and_steady_motion_share_adjustments(
    optimiser, config, monkeypatch, learn, prior, turns
):
    config.backend.turns = turns
    config.backend.relearn, config.backend.motion_prior = learn, prior
    made = Settled(optimiser, config, monkeypatch, 0.6)
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
def test_after_two_turns_the_next_sets_out_beyond_them(
    optimiser, config, monkeypatch, beyond, begun
):
    config.backend.turns, config.backend.beyond = 5, beyond
    made = Settled(optimiser, config, monkeypatch, 0.6, mark=math.e, halves=True)
    assert made.begun == pytest.approx(begun, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(("below", "turns"), [(0.65, 1), (0.55, 4)])
def test_one_turn_is_enough_for_what_is_tracked_once_more(
    optimiser, config, monkeypatch, below, turns
):
    config.backend.turns, config.frontend.again_below = 4, below
    made = Settled(optimiser, config, monkeypatch, 0.6)
    assert made.learned == turns * [True]


def test_nothing_is_done_that_is_not_asked_for(optimiser, config, monkeypatch):
    config.backend.splice = config.backend.relearn = False
    config.backend.motion_prior = 0.0
    made = Settled(optimiser, config, monkeypatch, 0.6, piece=range(3, 7))
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert made.learned == []
    assert made.compared == 0


@pytest.mark.parametrize("piece", [(), range(3, 7)])
def test_what_fails_after_the_way_back_leaves_it(optimiser, config, monkeypatch, piece):
    other = bent(optimiser.store, 0.6)
    failure = RuntimeError("no memory")
    made = Settled(optimiser, config, monkeypatch, 0.6, piece=piece, adjusted=failure)
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert torch.equal(optimiser.store.T_cw, other.T_cw)
    assert any("no memory" in text for text in made.events.warnings)


@pytest.mark.parametrize("piece", [(), range(3, 7)])
def test_a_run_that_is_to_end_keeps_the_best_so_far(optimiser, config, monkeypatch, piece):
    other = bent(optimiser.store, 0.6)
    made = Settled(optimiser, config, monkeypatch, 0.6, piece=piece, stopped=True)
    assert (made.kept.agreement, made.kept.backwards) == (0.6, 1.0)
    assert torch.equal(optimiser.store.T_cw, other.T_cw)
    assert torch.equal(optimiser.store.disps, other.disps)
    assert made.events.warnings == []
    assert len(made.learned) == 1  # given up in the first that was begun


@pytest.mark.parametrize(
    ("below", "agreement", "asked"),
    [(0.7, 0.69, 1), (0.7, 0.7, 0), (0.0, 0.0, 0), (1.0, 1.0, 1), (0.7, float("nan"), 0)],
)
def test_only_doubt_asks_for_it(optimiser, config, monkeypatch, below, agreement, asked):
    config.backend.backwards_below = below
    assert Settled(optimiser, config, monkeypatch, None, agreement).asked == asked


@pytest.mark.parametrize(
    ("link", "below", "asked"), [(0.14, 0.15, 1), (0.16, 0.15, 0), (0.0, 0.0, 0)]
)
def test_a_broken_path_is_in_doubt_however_much_agrees(
    optimiser, config, monkeypatch, caplog, link, below, asked
):
    config.backend.backwards_below, config.backend.broken_below = 0.7, below
    with caplog.at_level("INFO", "droidw"):
        made = Settled(optimiser, config, monkeypatch, None, 0.9, links=(link, 0.5, 0.5))
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
def test_a_way_that_has_not_broken_is_kept(optimiser, config, monkeypatch, links, found, back):
    config.backend.relearn, config.backend.motion_prior = False, 0.0
    made = Settled(optimiser, config, monkeypatch, found, links=links)
    assert made.kept.backwards == float(back)
    assert made.kept.weakest.share == links[2 if back else 1]
    assert made.kept.broken == (made.kept.weakest.share < config.backend.broken_below)


@pytest.mark.parametrize("fails", [False, True])
def test_correspondence_is_told_of_the_doubt_while_it_lasts(optimiser, config, monkeypatch, fails):
    asked = []
    session = optimiser.parts.correspondence.session("window")
    monkeypatch.setattr(
        session, "update", lambda r, update=session.update: asked.append(r.doubtful) or update(r)
    )
    if fails:
        monkeypatch.setattr(module._SecondLook, "_finish", lambda self: 1 / 0)
    diagnosis = Diagnosis(COUNT, COUNT, still=False, lost=0.0, agreement=0.5)
    doubted(optimiser, config, diagnosis, Dispatcher(), lambda: False)
    assert asked and all(asked)
    assert not optimiser.doubtful


@pytest.mark.parametrize("splice", [True, False])
def test_it_is_told_how_far_it_is(optimiser, config, splice):
    heard = Heard()
    config.backend.relearn, config.backend.splice = False, splice
    config.backend.motion_prior = 0.0
    diagnosis = Diagnosis(COUNT, COUNT, still=False, lost=0.0, agreement=0.5)
    doubted(optimiser, config, diagnosis, Dispatcher([("heard", heard)]), lambda: False)
    told = [(event.done, event.total) for event in heard.events]
    total = COUNT + 2 * (2 + splice)
    steps = [1, 2, *range(2, 2 + COUNT), COUNT + 3, COUNT + 4]
    assert told[: COUNT + 4] == [(k, total) for k in steps]
    assert told[-1] == (total, total)
    assert all(isinstance(event, Progress) for event in heard.events)


class Points:
    """Stand-ins for points that contradict the path in a piece.

    Args:
        gains: what `credit` says of the intervals of the piece, once for each path that is asked
            about.
    """

    def __init__(self, monkeypatch, gains, piece=range(3, 7)):
        self.gains, self.piece, self.set = list(gains), piece, 0
        monkeypatch.setattr(module, "matched_points", lambda optimiser: "points")
        monkeypatch.setattr(module, "contradicted", lambda *_: dict.fromkeys(piece))
        monkeypatch.setattr(module, "set_out", self.set_out)
        monkeypatch.setattr(module, "credit", self.credit)

    def set_out(self, optimiser, config, path, motions):
        self.set += 1
        k = torch.arange(float(COUNT))[:, None]
        turn = exp(k * torch.tensor([0.0, 0.0, 0.0, 0.02, 0.0, 0.0]))
        return replace(path, T_cw=mul(turn, path.T_cw))

    def credit(self, paths, supports, matches):
        assert matches == "points"
        gained = torch.zeros(COUNT - 1, dtype=torch.float64)
        gained[list(self.piece)] = self.gains.pop(0)
        return gained


@pytest.mark.parametrize(
    ("gains", "kept"), [([1.0, 0.5], True), ([1.0, -0.5], False), ([0.1], False)]
)
def test_pieces_that_points_contradict_set_out_anew(optimiser, config, monkeypatch, gains, kept):
    config.backend.turns = config.backend.restarts = 1
    points = Points(monkeypatch, gains)
    made = Settled(optimiser, config, monkeypatch, 0.6)
    assert (points.set, points.gains) == (1, [])
    # The first adjustment is of what sets out, the second of the pieces that are taken.
    assert made.learned == (len(gains) * [False]) + [True]
    assert made.priors[:-1] == len(gains) * [0.0]
    assert torch.allclose(optimiser.store.T_cw, made.found.T_cw) != kept
    assert made.kept.agreement == 0.6


def test_pieces_set_out_before_each_of_the_first_turns(optimiser, config, monkeypatch):
    config.backend.turns, config.backend.restarts = 4, 2
    points = Points(monkeypatch, [0.1, 0.1])
    made = Settled(optimiser, config, monkeypatch, 0.6)
    assert points.set == 2
    assert made.learned == [False, True, False, True, True, True]


@pytest.mark.parametrize(("restarts", "begun"), [(2, -0.5), (3, 0.25)])
def test_what_has_set_out_anew_is_not_led_beyond(optimiser, config, monkeypatch, restarts, begun):
    config.backend.turns, config.backend.restarts, config.backend.beyond = 3, restarts, 3.0
    asked = iter([False, False, True])
    monkeypatch.setattr(module, "matched_points", lambda optimiser: "points")
    monkeypatch.setattr(module._SecondLook, "_restart", lambda self, matches: next(asked))
    made = Settled(optimiser, config, monkeypatch, 0.6, mark=math.e, halves=True)
    assert made.begun == pytest.approx([1.0, 0.5, begun], rel=1e-5)


@pytest.mark.parametrize(("found", "weight"), [("points", 7.0), ("points", 0.0), (None, 7.0)])
def test_points_count_while_it_finishes(optimiser, config, monkeypatch, found, weight):
    config.backend.points, config.backend.restarts = weight, 0
    monkeypatch.setattr(module, "matched_points", lambda optimiser: found)
    made = Settled(optimiser, config, monkeypatch, 0.6)
    heard = (found, weight) if found and weight else None
    assert made.points == [heard] * config.backend.turns
    assert optimiser.points is None


def test_points_of_a_turn_are_those_that_are_matched_then(optimiser, config, monkeypatch):
    config.backend.restarts, config.backend.turns = 0, 3
    matched = iter(["some", None, "others"])
    monkeypatch.setattr(module, "matched_points", lambda optimiser: next(matched))
    made = Settled(optimiser, config, monkeypatch, 0.6)
    weight = config.backend.points
    assert made.points == [("some", weight), None, ("others", weight)]


def test_points_are_forgotten_where_it_breaks_off(optimiser, config, monkeypatch):
    monkeypatch.setattr(module, "matched_points", lambda optimiser: "points")
    made = Settled(optimiser, config, monkeypatch, 0.6, adjusted=RuntimeError("no memory"))
    assert made.events.warnings
    assert optimiser.points is None


def test_restarts_are_left_out_where_they_are_not_asked_for(optimiser, config, monkeypatch):
    config.backend.restarts = 0
    points = Points(monkeypatch, [])
    made = Settled(optimiser, config, monkeypatch, 0.6)
    assert points.set == 0
    assert made.learned == [True, True]


# Of a path that points contradict, agreement is what the wrong path makes of it.
@pytest.mark.parametrize(("left", "asked"), [(0.69, 1), (0.72, 0)])
def test_what_sets_out_anew_is_what_is_doubted(optimiser, config, monkeypatch, left, asked):
    config.backend.backwards_below, config.backend.turns = 0.7, 0
    before = optimiser.store.T_cw.clone()
    points = Points(monkeypatch, [1.0, 0.5])
    made = Settled(optimiser, config, monkeypatch, None, 0.75, again=left)
    assert (points.set, made.asked, points.gains) == (1, asked, [])
    assert made.kept.agreement == left
    assert made.kept.backwards == 0.0
    assert not torch.allclose(optimiser.store.T_cw, before)
    assert optimiser.points is None
    assert not optimiser.doubtful


def test_what_points_gain_nothing_by_is_left_as_it_was(optimiser, config, monkeypatch):
    config.backend.backwards_below = 0.7
    before = optimiser.store.T_cw.clone()
    points = Points(monkeypatch, [0.1])
    made = Settled(optimiser, config, monkeypatch, None, 0.75, again=0.5)
    assert (points.set, made.asked, made.kept.agreement) == (1, 0, 0.75)
    assert torch.equal(optimiser.store.T_cw, before)


@pytest.mark.parametrize(
    ("below", "agreement", "asked"),
    [(0.8, 0.79, 1), (0.8, 0.8, 0), (0.0, 0.71, 0), (1.0, 1.0, 1), (0.8, float("nan"), 0)],
)
def test_points_are_asked_where_not_quite_enough_agrees(
    optimiser, config, monkeypatch, below, agreement, asked
):
    config.backend.backwards_below, config.backend.restart_below = 0.7, below
    points = Points(monkeypatch, [0.1])
    made = Settled(optimiser, config, monkeypatch, None, agreement)
    assert (points.set, made.asked) == (asked, 0)


def test_points_count_while_pieces_set_out_first(optimiser, config, monkeypatch):
    config.backend.backwards_below, config.backend.points = 0.7, 3.0
    counted = []

    def run(backend, tell):
        counted.append(backend.optimiser.points)
        backend.agreement = 0.75

    Points(monkeypatch, [1.0, 0.5])
    monkeypatch.setattr(module.Backend, "run", run)
    monkeypatch.setattr(module, "support", lambda *_: torch.ones(COUNT - 1, dtype=torch.float64))
    diagnosis = Diagnosis(COUNT, COUNT, still=False, lost=0.0, agreement=0.75)
    doubted(optimiser, config, diagnosis, Dispatcher(), lambda: False)
    assert counted == [("points", 3.0)] * 2
