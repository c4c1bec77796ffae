"""How a camera is turned, from lines along three directions at right angles."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from droidw.geometry import se3
from droidw.solve.manhattan import (
    LineRays,
    axes_in_turn,
    named_like,
    next_axes,
    rotation_term,
    shared_axes,
)

INTRINSICS = (200.0, 210.0, 160.0, 120.0)


def turned(*degrees):
    return cv2.Rodrigues(np.radians(np.array(degrees, float)))[0]


def angle(one, other):
    return np.degrees(np.linalg.norm(cv2.Rodrigues(one @ other.T)[0]))


def project(X):
    fx, fy, cx, cy = INTRINSICS
    return np.stack([fx * X[:, 0] / X[:, 2] + cx, fy * X[:, 1] / X[:, 2] + cy], axis=1)


def seen(turn, count=30, astray=0, noise=0.0, seed=0):
    """Segments [n,4] along the columns of `turn`, and `astray` of no direction."""
    random = np.random.default_rng(seed)
    middle = np.concatenate(
        [random.uniform(-0.5, 0.5, (count, 2)), np.ones((count, 1))], axis=1
    ) * random.uniform(2.0, 5.0, (count, 1))
    along = turn.T[np.arange(count) % 3]
    half = random.uniform(0.1, 0.8, (count, 1))
    lines = np.concatenate([project(middle - half * along), project(middle + half * along)], axis=1)
    other = random.uniform(20, 220, (astray, 2))
    other = np.concatenate([other, other + random.uniform(-40, 40, (astray, 2))], axis=1)
    lines = np.concatenate([lines, other])
    return lines + noise * random.standard_normal(lines.shape)


TURN = turned(10, -25, 7)


def test_lines_point_to_their_vanishing_points():
    rays = LineRays(seen(TURN), INTRINSICS)
    least = np.abs(rays.distances(TURN)).min(axis=1)
    assert least.max() < 1e-9
    assert float(rays.cost(TURN)) < 1e-9
    assert rays.axes(TURN).share == 1.0
    off = np.abs(rays.distances(TURN @ turned(3, 0, 0))).min(axis=1)
    assert off.max() > 0.5


def test_distance_is_that_of_an_end_from_the_line_to_the_vanishing_point():
    segment = np.array([[100.0, 90.0, 140.0, 120.0]])
    rays = LineRays(segment, INTRINSICS)
    fx, fy, cx, cy = INTRINSICS
    away, end = np.array([120.0, 105.0]), np.array([140.0, 120.0])
    for axis, found in enumerate(np.abs(rays.distances(TURN))[0]):
        v = TURN[:, axis]
        vanishing = np.array([fx * v[0] / v[2] + cx, fy * v[1] / v[2] + cy])
        way = (vanishing - away) / np.linalg.norm(vanishing - away)
        distance = abs((end - away) @ np.array([-way[1], way[0]]))
        far = np.linalg.norm((vanishing - away) / (fx, fy))
        distance *= far / np.hypot(far, 0.25)
        # rays are scaled by the mean of both focal lengths, which here differ by a twentieth
        assert found == pytest.approx(distance, rel=0.06)


@pytest.mark.parametrize("seed", range(6))
def test_a_picture_tells_how_it_is_turned(seed):
    rays = LineRays(seen(TURN, astray=12, noise=0.15, seed=seed), INTRINSICS)
    best = named_like(rays.candidates()[0], TURN)
    assert angle(best, TURN) < 0.5
    assert rays.axes(best).share > 0.6


def test_information_is_what_noise_leaves():
    noise, errors, told = 0.15, [], []
    for seed in range(40):
        rays = LineRays(seen(TURN, count=60, noise=noise, seed=seed), INTRINSICS)
        found = rays.fitted(TURN)
        errors.append(cv2.Rodrigues(found @ TURN.T)[0][:, 0])
        told.append(np.linalg.inv(rays.axes(found).information))
    spread = np.cov(np.array(errors).T)
    # An end and its middle are half the difference of both ends: noise over root two.
    expected = np.mean(told, axis=0) * (noise / np.sqrt(2) / 0.2) ** 2
    assert np.trace(spread) == pytest.approx(np.trace(expected), rel=0.6)


def test_names_change_and_the_turn_does_not():
    other = turned(1, 1, 1)
    for names in (turned(0, 0, 90), turned(90, 0, 0) @ turned(0, 90, 0)):
        assert angle(named_like(other @ names, other), other) < 1e-6


def test_a_fit_comes_from_far():
    rays = LineRays(seen(TURN, astray=6, noise=0.1), INTRINSICS)
    assert angle(rays.fitted(turned(6, 5, -4) @ TURN), TURN) < 0.5


def test_the_next_picture_is_looked_for_near_the_last():
    rays = LineRays(seen(TURN, noise=0.1), INTRINSICS)
    near = turned(0, 12, 0) @ TURN
    found = next_axes(rays, [near])
    assert found is not None
    assert angle(found.turn, TURN) < 0.5
    assert found.share > 0.9
    few = LineRays(seen(TURN, count=4), INTRINSICS)
    assert next_axes(few, [near]) is None
    assert next_axes(rays, []) is None


def door(degrees, count, walls):
    """Lines of a door that stands open by so much, and as many of the wall behind it."""
    ajar = seen(TURN @ turned(0, degrees, 0), count=count, noise=0.05, seed=3)
    return LineRays(np.concatenate([ajar, seen(TURN, count=walls, noise=0.05, seed=4)]), INTRINSICS)


@pytest.mark.parametrize("degrees", [9, 15, 46])
def test_an_open_door_does_not_lead_a_camera_away(degrees):
    rays = door(degrees, 24, 12)
    alone = rays.candidates()[0]
    assert angle(named_like(alone, TURN), TURN) > 5
    found = next_axes(rays, [turned(0.5, 1, -0.5) @ TURN])
    assert angle(found.turn, TURN) < 1.5


def test_nothing_but_a_door_is_followed_as_far_as_a_camera_turns():
    near = turned(1, 0, 1) @ TURN
    turn = TURN @ turned(0, 12, 0)
    assert angle(next_axes(LineRays(seen(turn), INTRINSICS), [near]).turn, turn) < 0.1
    found = next_axes(door(46, 24, 0), [near])
    assert angle(found.turn, near) < 21


def test_pictures_in_turn_have_the_same_names_and_outvote_one_that_is_misled():
    turns = [turned(0, 4 * k, 0) @ TURN for k in range(8)]
    pictures = [LineRays(seen(turn, noise=0.1, seed=k), INTRINSICS) for k, turn in enumerate(turns)]
    # In the first most of the lines are those of something that stands askew.
    askew = np.concatenate(
        [seen(turned(0, 33, 14) @ turns[0], count=40), seen(turns[0], count=21, noise=0.1, seed=9)]
    )
    pictures[0] = LineRays(askew, INTRINSICS)
    alone = pictures[0].candidates()[0]
    assert angle(named_like(alone, turns[0]), turns[0]) > 5
    found = axes_in_turn(pictures)
    names = named_like(found[0].turn, turns[0]).T @ found[0].turn
    for axes, turn in zip(found, turns, strict=True):
        assert angle(axes.turn, turn @ names) < 0.7


def test_pictures_without_lines_have_no_axes():
    pictures = [LineRays(np.zeros((0, 4)), INTRINSICS), LineRays(seen(TURN), INTRINSICS)]
    assert axes_in_turn(pictures)[0] is None
    assert axes_in_turn(pictures)[1] is not None
    assert axes_in_turn([]) == []
    assert axes_in_turn(pictures[:1]) == [None]


def poses(count=5, seed=3):
    g = torch.Generator().manual_seed(seed)
    return se3.exp(0.4 * torch.randn(count, 6, generator=g, dtype=torch.float64))


def information(count, seed=4):
    g = torch.Generator().manual_seed(seed)
    root = torch.randn(count, 3, 3, generator=g, dtype=torch.float64)
    return root @ root.mT


def test_the_term_is_what_differentiation_finds():
    T, H = poses(), information(5)
    upright = torch.from_numpy(TURN)
    off = se3.exp(0.0005 * torch.randn(5, 6, dtype=torch.float64, generator=torch.manual_seed(0)))
    turns = se3.rotation(off) @ se3.rotation(T) @ upright
    term = rotation_term(T, turns, H, upright, 3.0)
    term.check(5)

    def energy(x):
        R = se3.rotation(se3.mul(se3.exp(x), T))
        M = turns @ upright.T @ R.mT
        away = torch.nn.functional.pad(M, (0, 1))
        w = se3.log(se3.from_matrix(away))[:, 3:]
        return 3.0 * torch.einsum("ni,nij,nj->", w, H, w)

    x = torch.zeros(5, 6, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(energy(x), x)
    assert torch.allclose(term.rhs, -0.5 * gradient, rtol=0.03, atol=1e-4)
    # A whole step of it alone brings every camera where its lines say.
    step = torch.zeros(5, 6, dtype=torch.float64)
    step[:, 3:] = torch.linalg.solve(term.band[:, 0, 3:, 3:], term.rhs[:, 3:])
    assert float(energy(step)) < 1e-3 * float(energy(torch.zeros_like(step)))


def off_by(degrees, T, upright):
    """What lines say of cameras that are turned by so much each about one of their axes."""
    about = torch.eye(3, dtype=torch.float64).repeat(len(T), 1)[: len(T)]
    vectors = torch.nn.functional.pad(torch.deg2rad(degrees)[:, None] * about, (3, 0))
    return se3.rotation(se3.exp(vectors)) @ se3.rotation(T) @ upright


def test_a_picture_that_is_misled_hardly_pulls():
    T, H, upright = poses(1), information(1), torch.from_numpy(TURN)
    pulls = []
    for degrees in (0.1, 1.0, 7.0):
        turns = torch.from_numpy(turned(degrees, 0, 0)) @ se3.rotation(T) @ upright
        pulls.append(float(rotation_term(T, turns, H, upright, 1.0).rhs.norm()) / degrees)
    assert pulls[0] > 1.9 * pulls[1] > 0
    assert pulls[0] == pytest.approx(50 * pulls[2], rel=0.02)


def test_nor_does_it_pull_at_all_once_the_others_are_settled():
    T, H, upright = poses(9), torch.eye(3).double().expand(9, 3, 3), torch.from_numpy(TURN)
    pulls = []
    for degrees in (0.1, 1.0, 2.5):
        each = torch.tensor([0.1] * 8 + [degrees], dtype=torch.float64)
        term = rotation_term(T, off_by(each, T, upright), H, upright, 1.0, settled=True)
        pulls.append(term.rhs.norm(dim=1))
    assert float(pulls[0].min()) > 0.8 * np.radians(0.1)
    assert float(pulls[1][-1]) < 0.25 * float(pulls[0][-1])
    assert float(pulls[2][-1]) < 0.02 * float(pulls[0][-1])
    # where all are off, none is misled
    each = torch.full((9,), 1.0, dtype=torch.float64)
    term = rotation_term(T, off_by(each, T, upright), H, upright, 1.0, settled=True)
    assert float(term.rhs.norm(dim=1).min()) > 0.2 * np.radians(1.0)


def test_what_all_go_by_is_better_known_than_by_the_first_picture():
    T, H, upright = poses(60), torch.eye(3).double().expand(60, 3, 3), torch.from_numpy(TURN)
    each = 0.2 * torch.randn(60, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    each[0], each[7] = 0.5, 30.0
    found = shared_axes(T, off_by(each, T, upright), H)
    assert angle(found.numpy(), TURN) < 0.06
    alone = shared_axes(T[:1], off_by(each, T, upright)[:1], H[:1])
    assert angle(alone.numpy(), TURN) == pytest.approx(0.5, abs=1e-6)


def test_where_a_path_is_bent_all_go_by_its_beginning():
    """Else the first pose, which is held, would be left behind."""
    T, H, upright = poses(60), torch.eye(3).double().expand(60, 3, 3), torch.from_numpy(TURN)
    each = torch.zeros(60, dtype=torch.float64)
    each[10:] = 12.0
    about = torch.zeros(60, 6, dtype=torch.float64)
    about[:, 4] = torch.deg2rad(each)
    turns = se3.rotation(T) @ se3.rotation(se3.exp(about)) @ upright
    assert angle(shared_axes(T, turns, H).numpy(), TURN) < 0.05


def test_the_term_is_silent_where_lines_are():
    T, upright = poses(), torch.eye(3, dtype=torch.float64)
    H = information(5)
    H[2] = 0.0
    term = rotation_term(T, torch.zeros(5, 3, 3, dtype=torch.float64), H * 0, upright, 3.0)
    assert float(term.band.abs().sum()) == 0.0
    assert bool(torch.isfinite(term.rhs).all())
    assert float(term.rhs.abs().sum()) == 0.0
    term = rotation_term(T, se3.rotation(T), H, upright, 3.0)
    assert float(term.band[2].abs().sum()) == 0.0
    assert float(term.rhs.abs().max()) < 1e-9


def test_the_term_moves_behind_poses_of_which_nothing_is_known():
    T, H = poses(), information(5)
    upright = torch.from_numpy(TURN)
    term = rotation_term(T, se3.rotation(poses(seed=5)) @ upright, H, upright, 3.0)
    moved = term.after(2)
    moved.check(7)
    steps = torch.randn(7, 6, dtype=torch.float64, generator=torch.manual_seed(1))
    assert float(moved.energy(steps)) == pytest.approx(float(term.energy(steps[2:])), rel=1e-12)


def test_a_line_through_a_vanishing_point_does_not_tell_where_that_is():
    fx, fy, cx, cy = INTRINSICS
    v = TURN[:, 2]
    vanishing = np.array([fx * v[0] / v[2] + cx, fy * v[1] / v[2] + cy])
    lines = seen(TURN)
    reach = np.array([15.0, 9.0])
    through = np.concatenate([vanishing - reach, vanishing + reach])[None]
    plain = LineRays(lines, INTRINSICS).axes(TURN).information
    for off in (0.0, 1e-9, 1e-3, 1.0):
        rays = LineRays(np.concatenate([lines, through + off]), INTRINSICS)
        more = rays.axes(TURN).information - plain
        assert np.abs(more).max() < 0.25 * np.abs(plain).max()
        assert angle(rays.fitted(turned(2, 1, 0) @ TURN), TURN) < 0.1
