"""Whether a path has come to rest."""

from __future__ import annotations

import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import exp, mul
from droidw.slam.convergence import moved_by
from droidw.slam.path import Path

H, W, COUNT = 6, 9, 30


@pytest.fixture
def path(arc, waves, stored):
    """`path(count)`: a store with so many keyframes, and gates that are all open."""

    def make(count=COUNT):
        grid = Grid(H, W, 8, 3.5)
        intrinsics = torch.tensor([82.0, 82.0, 35.5, 23.5])
        store = stored(grid, intrinsics, arc(count), waves(count, H, W))
        return store, torch.ones(count, H, W)

    return make


def turn(store, many, by=0.01):
    """Turn the last keyframes about their centres, each by so many radians more than the last."""
    angles = torch.zeros(many, 6)
    angles[:, 4] = by * torch.arange(1, many + 1)
    store.T_cw[-many:] = mul(exp(angles), store.T_cw[-many:])


def test_what_has_no_say_in_pictures_is_no_motion(path):
    """Where the world lies, and how large it is, no picture tells."""
    store, gates = path()
    before = Path.of(store)
    assert moved_by(before, store, gates) == 0
    store.write(mul(before.T_cw, exp(torch.tensor([[3.0, -2, 1, 0.4, 0.8, -0.3]]))), before.disps)
    assert moved_by(before, store, gates) < 1e-5
    store.T_cw[:, :3] *= 5
    store.disps.div_(5)
    assert moved_by(before, store, gates) < 1e-5


def test_it_is_counted_in_cells(path):
    store, gates = path(2)
    before = Path.of(store)
    turn(store, 1)
    ii, jj = torch.tensor([0, 1]), torch.tensor([1, 0])
    was, now = (
        reproject(T, before.disps, store.intrinsics, ii, jj)[0] for T in (before.T_cw, store.T_cw)
    )
    by = (was - now).norm(dim=-1)
    assert by.median() > 0.01 * 82 / 8  # what turns by an angle moves at least so far
    assert moved_by(before, store, gates) == pytest.approx(float(by.median()), rel=0.1)


@pytest.mark.parametrize(("many", "counts"), [(2, False), (6, True)])
def test_a_few_keyframes_that_stray_are_not_waited_for(path, many, counts):
    store, gates = path()
    before = Path.of(store)
    turn(store, many)
    assert (moved_by(before, store, gates) > 0.1) is counts


def test_what_is_closed_does_not_count(path):
    store, gates = path()
    before = Path.of(store)
    store.disps[:, : H // 2 + 1] *= 1.3
    whole = moved_by(before, store, gates)
    gates[:, : H // 2 + 1] = 0.2
    assert whole > 0.02
    assert moved_by(before, store, gates) == 0
    gates[:] = 0.2
    assert moved_by(before, store, gates) == 0


def test_one_keyframe_is_at_rest(path):
    store, gates = path(1)
    before = Path.of(store)
    turn(store, 1)
    assert moved_by(before, store, gates) == 0
