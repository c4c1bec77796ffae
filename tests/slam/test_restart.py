"""Pieces of a path that points contradict, and what sets out in their place."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from droidw.config.schema import DroidwConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import act, exp, inv, log, mul
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.path import Path
from droidw.slam.restart import contradicted, credit, matched_points, set_out
from droidw.slam.timing import Stopwatch
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

H, W, COUNT = 8, 12, 30
GRID, INTRINSICS = Grid(H, W, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5])
PIECE = range(8, 16)


@pytest.fixture
def truth(waves):
    """Poses of a steady camera and disparities of all keyframes."""
    motion = exp(torch.tensor([-0.1, 0.02, 0.03, 0.0, 0.01, 0.004]))
    T_cw = [torch.tensor([0, 0, 0, 0, 0, 0, 1.0])]
    for _ in range(COUNT - 1):
        T_cw.append(mul(motion, T_cw[-1]))
    return torch.stack(T_cw), waves(COUNT, H, W)


def bent(T_cw, piece=PIECE, by=(0.0, 0.0, 0.0, 0.0, 0.1, 0.0)):
    """The same path, but for the motions of a piece of it."""
    off, made = exp(torch.tensor(by)), [T_cw[0]]
    for k, motion in enumerate(mul(T_cw[1:], inv(T_cw[:-1]))):
        made.append(mul(mul(off, motion) if k in piece else motion, made[-1]))
    return torch.stack(made)


class Seen:
    """What a correspondence that measures exactly finds of a scene.

    Args:
        astray: share of points that are matched with something else.
    """

    def __init__(self, T_cw, disps, astray=0.0):
        self.T_cw, self.disps, self.astray = T_cw, disps, astray

    def session(self, purpose):
        return SimpleNamespace(update=self.update, forget=lambda ids: None)

    def update(self, request):
        ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
        target, valid = reproject(self.T_cw, self.disps, GRID.intrinsics(INTRINSICS), ii, jj)
        return EdgeUpdate(target, valid[..., None].float().expand_as(target).contiguous())

    def matched_points(self, a, b, gate_a, gate_b):
        """Forty points of the first picture, but for its closed cells."""
        random = np.random.default_rng(100 * a + b)
        here = random.uniform((0, 0), (8 * W - 1, 8 * H - 1), (40, 2))
        cell = ((here - 3.5) / 8).round().astype(int).clip(0, (W - 1, H - 1))
        here = torch.from_numpy(here[gate_a[cell[:, 1], cell[:, 0]] > 0.5])
        fx, fy, cx, cy = INTRINSICS.double()
        depth = torch.from_numpy(random.uniform(1.0, 4.0, len(here)))
        ray = torch.stack(
            [(here[:, 0] - cx) / fx, (here[:, 1] - cy) / fy, torch.ones(len(here))], 1
        )
        T = self.T_cw.double()
        X = act(mul(T[b], inv(T[a])), ray * depth[:, None])
        there = torch.stack([fx * X[:, 0] / X[:, 2] + cx, fy * X[:, 1] / X[:, 2] + cy], 1)
        wrong = torch.from_numpy(random.random(len(here)) < self.astray)
        there[wrong] += 30 * torch.from_numpy(random.standard_normal((int(wrong.sum()), 2)))
        return torch.cat([here, there], 1).numpy()


@pytest.fixture
def optimiser(truth, stored):
    """`optimiser(T_cw, astray)`: of a run that has come to this path."""

    def make(T_cw, astray=0.0):
        T, disps = truth
        parts = Parts(None, None, None, TorchBundleAdjuster(), Seen(T, disps, astray))
        store = stored(GRID, INTRINSICS.clone(), T_cw, disps)
        for k, info in enumerate(store.infos):
            info.payload = k
        return Optimiser(store, parts, DroidwConfig().weighting, Stopwatch())

    return make


def turns_off(T_cw, truth):
    """Degrees by which motions between keyframes are off, [N-1]."""
    motion, right = (mul(T[1:], inv(T[:-1])) for T in (T_cw, truth))
    return torch.rad2deg(log(mul(motion, inv(right)))[:, 3:].norm(dim=1))


def look(made):
    matches, gates = matched_points(made), made.gates()
    return contradicted(Path.of(made.store), matches, made.store.intrinsics, gates)


def test_points_are_rays_of_keyframes_that_are_near(optimiser, truth):
    made = optimiser(truth[0])
    made.store["unmasked"][3] = 0.0
    found = matched_points(made)
    gap = found.jj - found.ii
    assert set(gap.tolist()) == {1, 2}
    assert not (found.ii == 3).any()
    assert len(found) == 40 * (2 * COUNT - 3 - 2)
    assert (found.here[:, 2] == 1).all()
    assert found.focal == pytest.approx(82.0)
    place = found.here[:40, :2] * 82.0 + torch.tensor([47.5, 31.5])
    first = torch.from_numpy(made.parts.correspondence.matched_points(0, 1, *np.ones((2, H, W))))
    assert torch.allclose(place, first[:, :2])


def test_there_are_none_without_a_correspondence_that_matches_points(optimiser, truth):
    made = optimiser(truth[0])
    blind = SimpleNamespace(session=made.parts.correspondence.session)
    made.parts = replace(made.parts, correspondence=blind)
    assert matched_points(made) is None
    made = optimiser(truth[0])
    made.store["unmasked"][:] = 0.0
    assert matched_points(made) is None


def test_what_points_agree_with_is_left_alone(optimiser, truth):
    assert look(optimiser(truth[0])) == {}


@pytest.mark.parametrize("astray", [0.0, 0.1])
def test_the_piece_that_points_contradict_is_found(optimiser, truth, astray):
    made = optimiser(bent(truth[0]), astray)
    motions = look(made)
    assert set(PIECE) <= set(motions)
    T_cw = made.store.T_cw
    found = mul(T_cw[1:], inv(T_cw[:-1])).double()
    for k, motion in motions.items():
        found[k] = motion
    right = mul(truth[0][1:], inv(truth[0][:-1])).double()
    off = torch.rad2deg(log(mul(found, inv(right)))[:, 3:].norm(dim=1))
    assert off.max() < 0.5
    assert turns_off(T_cw, truth[0]).max() > 2.0


def test_nothing_is_said_where_too_many_points_are_astray(optimiser, truth):
    assert look(optimiser(bent(truth[0]), 0.4)) == {}


def test_what_sets_out_has_the_depths_that_go_with_it(optimiser, truth):
    T_cw, disps = truth
    made = optimiser(bent(T_cw))
    made.store["disps"][8:16] *= 1.2
    right = mul(T_cw[1:], inv(T_cw[:-1]))
    path = Path.of(made.store)
    other = set_out(made, DroidwConfig(), path, {k: right[k].double() for k in PIECE})
    assert torch.allclose(other.T_cw, T_cw, atol=1e-3)
    assert turns_off(path.T_cw, T_cw).max() > 2.0
    assert (other.disps / disps - 1).abs().median() < 0.01
    assert torch.equal(made.store.T_cw, other.T_cw)


def test_credit_is_what_points_gain_and_dense_matches_lose(optimiser, truth):
    made = optimiser(truth[0])
    matches = matched_points(made)
    right = Path.of(made.store)
    wrong = replace(right, T_cw=bent(truth[0]))
    same = torch.ones(COUNT - 1, dtype=torch.float64)
    gained = credit((wrong, right), (same, same), matches)
    inside = torch.tensor([k in PIECE for k in range(COUNT - 1)])
    assert gained[inside].min() > 1.0
    assert gained[~inside][:6].abs().max() < 0.1
    assert torch.allclose(credit((right, wrong), (same, same), matches), -gained)
    less = credit((wrong, right), (same, 0.5 * same), matches)
    assert torch.allclose(less, gained - 2 * 2 / 3)
