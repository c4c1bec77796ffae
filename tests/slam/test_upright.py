"""Keyframes that are turned as the lines in them say."""

from __future__ import annotations

import logging
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from droidw.config.schema import LinesConfig
from droidw.geometry import se3
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject, viewing_rays
from droidw.graph.store import KeyframeInfo, KeyframeStore
from droidw.slam.timing import Stopwatch
from droidw.slam.upright import Upright
from droidw.solve.problem import BAProblem

GRID, INTRINSICS = Grid(15, 20, 16, 7.5), torch.tensor([200.0, 200.0, 160.0, 120.0])
COUNT = 8


def turn(*w):
    return se3.exp(torch.tensor([0.0, 0, 0, *w], dtype=torch.float64))


def apart(one, other):
    """Degrees between the rotations of two poses [...,7]."""
    w = se3.log(se3.mul(one.double(), se3.inv(other.double())))[..., 3:]
    return torch.rad2deg(w.norm(dim=-1))


def lines_of(pose, random, count=40):
    """Segments [count,4] along the axes of the world, as a camera sees them."""
    R = se3.rotation(pose.double()).numpy()
    middle = random.uniform((-2, -1.5, 3), (2, 1.5, 5), (count, 3))
    along = 0.4 * R.T[np.arange(count) % 3]
    ends = np.stack([middle - along, middle + along], axis=1)
    return (200.0 * ends[..., :2] / ends[..., 2:] + (160, 120)).reshape(count, 4)


def poses(count=COUNT):
    """A camera that turns and goes on; the first one is not turned."""
    made = [torch.tensor([0, 0, 0, 0, 0, 0, 1.0])]
    motion = se3.exp(torch.tensor([0.1, 0.0, 0.02, 0.01, 0.05, 0.0]))
    for _ in range(count - 1):
        made.append(se3.mul(motion, made[-1]))
    return torch.stack(made)


@pytest.fixture
def build():
    """Keyframes whose poses have not been turned, and what lines say of the true ones."""

    def make(weight=30.0, least_share=0.75, lines=None, gates=None, known=True):
        true = poses()
        random = np.random.default_rng(0)
        found = [lines_of(pose, random) for pose in true] if lines is None else lines
        part = SimpleNamespace(line_segments=lambda number: found[number])
        store = KeyframeStore(GRID, INTRINSICS.clone())
        upright = Upright(
            store,
            part if known else SimpleNamespace(),
            LinesConfig(weight, least_share),
            gates or (lambda first: torch.ones(len(store) - first, GRID.height, GRID.width)),
            Stopwatch(),
        )
        still = torch.tensor([0, 0, 0, 0, 0, 0, 1.0])

        def append(number, pose=still):
            image = np.zeros((240, 320, 3), np.uint8)
            store.append(KeyframeInfo(number, 0.1 * number, "", image, number), T_cw=pose)
            upright.see(number)

        return upright, store, append, true

    return make


def test_the_first_keyframes_are_turned_together(build, caplog):
    upright, store, append, true = build()
    for number in range(COUNT - 1):
        append(number)
    assert upright.holds is None
    assert bool((apart(store.T_cw, true[:1]) < 1e-3).all())
    with caplog.at_level(logging.INFO, "droidw"):
        upright.begin()
    assert upright.holds
    assert "100 %" in caplog.text
    assert float(apart(store.T_cw, true[: COUNT - 1]).max()) < 0.05
    # Where they are is left to matches.
    assert float(store.T_cw[:, :3].abs().max()) == 0.0


def test_a_later_keyframe_is_turned_about_its_centre(build):
    upright, store, append, true = build()
    for number in range(COUNT - 1):
        append(number)
    upright.begin()
    guess = se3.mul(se3.exp(torch.tensor([0.0, 0, 0, 0.1, -0.15, 0.05])), true[-1])
    append(COUNT - 1, guess)
    assert float(apart(store.T_cw[-1], true[-1])) < 0.05
    assert torch.allclose(se3.inv(store.T_cw[-1])[:3], se3.inv(guess)[:3], atol=1e-6)


def test_what_lines_say_leads_back(build):
    upright, store, append, true = build()
    for number in range(COUNT):
        append(number)
    upright.begin()
    store.T_cw[3] = se3.mul(turn(0.02, 0.01, -0.03).float(), store.T_cw[3])
    term = upright.term(store.T_cw[2:], 2, usual=0.01)
    term.check(COUNT - 2)
    assert float(term.band[0].abs().max()) > 0
    step = torch.linalg.solve(term.band[1, 0, 3:, 3:], term.rhs[1, 3:])
    back = se3.mul(turn(*step.tolist()), store.T_cw[3].double())
    assert float(apart(back, true[3])) < 0.1
    other = upright.term(store.T_cw[2:], 2, usual=0.02)
    assert torch.allclose(other.rhs, 2 * term.rhs)


def test_walls_are_flat_in_a_problem_of_all_keyframes_where_lines_count(build):
    upright, store, append, _ = build()
    for number in range(COUNT):
        append(number)
    upright.begin()
    # a wall 2 in front of the first camera, square to the axes
    rays = viewing_rays(GRID.height, GRID.width, store.intrinsics)
    R, centres = se3.rotation(store.T_cw), se3.inv(store.T_cw)[:, :3]
    ahead = torch.einsum("nj,hwj->nhw", R[:, :, 2], rays)
    store.disps[:] = (ahead / (2.0 - centres[:, 2, None, None])).clamp_min(1e-3)
    count = torch.arange(COUNT)
    ii, jj = count[:-1], count[1:]
    target, _ = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
    problem = BAProblem(
        store.T_cw, store.disps, store.intrinsics, ii, jj, target,
        torch.ones_like(target), count == 0, torch.ones_like(store.disps),
    )  # fmt: skip
    gates = torch.ones_like(store.disps)
    held = upright.flat(problem, gates, 0.1)
    assert len(held.T_cw) == COUNT + 1
    assert len(held.ii) == len(ii) + COUNT
    assert upright.flat(problem, gates, 0.0) is problem
    part = replace(problem, T_cw=problem.T_cw[1:])
    assert upright.flat(part, gates[1:], 0.1) is part
    upright.holds = False
    assert upright.flat(problem, gates, 0.1) is problem


def askew(count=COUNT, seed=1):
    """Lines of no direction."""
    random = np.random.default_rng(seed)
    a = random.uniform(20, 200, (count, 40, 2))
    return list(np.concatenate([a, a + random.uniform(-60, 60, a.shape)], axis=2))


def test_lines_of_no_direction_do_not_count(build):
    upright, store, append, true = build(lines=askew())
    for number in range(COUNT):
        append(number)
    upright.begin()
    assert upright.holds is False
    assert bool((apart(store.T_cw, true[:1]) < 1e-3).all())
    assert upright.term(store.T_cw, 0, 1.0) is None
    upright.turn(3)
    assert upright.measure() == 0.0


def test_lines_that_lose_their_directions_count_no_longer(build, caplog):
    upright, store, append, _ = build()
    for number in range(COUNT):
        append(number)
    upright.begin()
    upright.again()
    assert upright.holds
    for info, lines in zip(store.infos, askew(), strict=True):
        info.lines = lines
    with caplog.at_level(logging.INFO, "droidw"):
        upright.again()
    assert upright.holds is False
    assert "no longer count" in caplog.text
    assert upright.term(store.T_cw, 0, 1.0) is None


def hidden(share, count=lambda: COUNT):
    """Gates with this share of each picture closed, at its left.

    Args:
        count: how many keyframes there are.
    """

    def gates(first):
        found = torch.ones(count() - first, GRID.height, GRID.width)
        found[:, :, : round(share * GRID.width)] = 0.0
        return found

    return gates


@pytest.mark.parametrize(("share", "counts"), [(0.2, True), (0.0, False)])
def test_lines_that_come_into_sight_count_while_tracking_goes_on(build, share, counts):
    """Where much is hidden; elsewhere the first keyframes have said what there is to say."""
    count, random = 17, np.random.default_rng(0)
    true = poses(count)
    lines = askew(5) + [lines_of(pose, random) for pose in true[5:]]

    gates = hidden(share, lambda: len(store))
    upright, store, append, _ = build(lines=lines, gates=gates)
    drift = turn(0.04, 0.02, -0.03).float()
    for number, pose in enumerate(true):
        append(number, se3.mul(drift, pose) if number > 5 else pose)
        if number == 4:
            upright.begin()
            assert upright.holds is False
        assert upright.holds is None or upright.holds == (counts and number >= 15)
    # what has drifted is turned back, and what comes later is turned as the rest
    off = apart(store.T_cw[6:], true[6:])
    assert off.tolist() == pytest.approx([0.0 if counts else 3.085] * len(off), abs=0.1)


def test_a_keyframe_from_between_is_no_reason_to_ask_again(build, monkeypatch):
    upright, store, append, _ = build(lines=askew(16))
    for number, pose in enumerate(poses(15)):
        append(number, pose)
        if number == 4:
            upright.begin()
    asked = []
    monkeypatch.setattr(upright, "again", lambda: asked.append(len(store)))
    append(15)
    upright.see(7)
    assert asked == [16]


def half_askew():
    """Lines along the axes in the right half of each picture, and of no direction in the left."""
    random = np.random.default_rng(2)
    found = []
    for pose, other in zip(poses(), askew(seed=5), strict=True):
        good = lines_of(pose, random)
        good = good[good[:, [0, 2]].mean(axis=1) > 165]
        bad = other * (0.6, 1.0, 0.6, 1.0)
        found.append(np.concatenate([good, bad[bad[:, [0, 2]].mean(axis=1) < 150]]))
    return found


def test_nor_do_those_that_uncertainty_closes(build):
    """In half of the picture lines stand askew; where it is closed the others decide."""
    mixed = half_askew()

    for gates, holds in ((None, False), (hidden(0.5), True)):
        upright, store, append, true = build(lines=mixed, gates=gates, least_share=0.9)
        for number in range(COUNT):
            append(number)
        upright.begin()
        assert upright.holds is holds
    assert float(apart(store.T_cw, true).max()) < 0.1


def test_lines_count_once_what_hid_them_is_closed(build, caplog):
    """In the left half stand edges of what moves; when tracking begins nobody knows that."""
    mixed = half_askew()
    known = {"gates": hidden(0.0)}
    upright, store, append, true = build(
        lines=mixed, gates=lambda first: known["gates"](first), least_share=0.9
    )
    for number in range(COUNT):
        append(number)
        if number == 3:
            upright.begin()
    assert upright.holds is False
    assert store.infos[COUNT - 1].lines is None  # nobody asked since
    upright.again()
    assert upright.holds is False
    known["gates"] = hidden(0.5)
    with caplog.at_level(logging.INFO, "droidw"):
        upright.again()
    assert upright.holds
    assert "count from now on" in caplog.text
    assert float(apart(store.T_cw, true).max()) < 0.1


@pytest.mark.parametrize(("share", "holds"), [(0.0, False), (0.5, True)])
def test_lines_are_asked_once_more_where_something_is_hidden(build, share, holds):
    upright, store, append, _ = build(lines=askew(), gates=hidden(share))
    for number in range(COUNT):
        append(number)
    upright.begin()
    random = np.random.default_rng(0)
    for info, pose in zip(store.infos, poses(), strict=True):
        info.lines = lines_of(pose, random)
    upright.again()
    assert upright.holds is holds


@pytest.mark.parametrize("how", [{"weight": 0.0}, {"known": False}])
def test_where_lines_are_not_asked_nothing_happens(build, how):
    upright, store, append, _ = build(gates=hidden(0.5), **how)
    for number in range(COUNT):
        append(number)
    upright.begin()
    upright.again()
    assert upright.holds is False
    assert store.infos[0].lines is None
    assert upright.term(store.T_cw, 0, 1.0) is None


def test_less_is_doubted_where_lines_count(build):
    upright, _store, append, _ = build()
    for number in range(COUNT):
        append(number)
    below = 0.7 * LinesConfig().doubt
    assert upright.doubts(0.69, 0.7) and not upright.doubts(0.71, 0.7)
    upright.begin()
    assert upright.doubts(below - 0.01, 0.7) and not upright.doubts(below + 0.01, 0.7)
    assert not upright.doubts(0.0, 0.0)
    assert upright.doubts(0.99, 1.0) and upright.doubts(1.0, 1.0)
    upright.holds = False
    assert upright.doubts(0.69, 0.7)


def test_few_keyframes_without_lines_decide_against(build):
    upright, _store, append, _ = build(lines=[np.zeros((0, 4))] * COUNT)
    append(0)
    upright.begin()
    assert upright.holds is False


def test_another_store_goes_by_the_same_decision(build):
    upright, store, append, true = build()
    for number in range(COUNT):
        append(number)
    upright.begin()
    other, backwards, *_ = build()
    other.like(upright)
    for number in reversed(range(COUNT)):
        backwards.append(store.infos[number], **store.values(number))
    backwards.T_cw[3] = se3.mul(turn(0.3, 0, 0).float(), backwards.T_cw[3])
    other.turn(3)
    assert float(apart(backwards.T_cw[3], true[COUNT - 1 - 3])) < 0.05


@pytest.mark.parametrize("how", ["measure", "refit"])
def test_axes_go_by_the_focal_length(build, how):
    upright, store, append, _ = build(least_share=0.2)
    for number in range(COUNT):
        append(number)
    upright.begin()
    right = store["axes"].clone()
    store.image_intrinsics[:2] *= 1.15
    getattr(upright, how)()
    off = torch.linalg.matrix_norm(store["axes"] - right, dim=(1, 2))
    assert float(off.max()) > 0.02
    store.image_intrinsics[:2] /= 1.15
    upright.again()
    assert upright.holds
    assert torch.allclose(store["axes"], right, atol=1e-5)


def test_axes_are_fitted_again_where_they_are_known(build):
    upright, store, append, _ = build()
    for number in range(COUNT):
        append(number)
    upright.begin()
    right = store["axes"].clone()
    store["axes"][2] = se3.rotation(turn(0.03, -0.02, 0.01)) @ right[2]
    store["axes_information"][5] = 0.0
    upright.refit()
    assert torch.allclose(store["axes"], right, atol=1e-5)
    known = store["axes_information"].flatten(1).any(dim=1)
    assert known.tolist() == [number != 5 for number in range(COUNT)]


def test_lines_are_off_least_at_the_true_focal_length(build):
    upright, store, append, _ = build(least_share=0.0)
    for number in range(COUNT):
        append(number)
    upright.begin()
    off = []
    for factor in (0.97, 0.99, 1.0, 1.01, 1.03):
        store.image_intrinsics[:2] = factor * INTRINSICS[:2]
        off.append(upright.refit())
    assert off[0] > off[1] > off[2] < off[3] < off[4]
    assert off[2] < 0.01 * off[1]


def test_nothing_is_fitted_where_lines_do_not_count(build):
    upright, store, append, _ = build(lines=askew())
    for number in range(COUNT):
        append(number)
    upright.begin()
    assert upright.refit() == 0.0
    assert not bool(store["axes_information"].any())
