"""Alignment and interpolation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.errors import InputError
from droidw.geometry import se3
from droidw.geometry.align import umeyama
from droidw.geometry.interpolate import interpolate


def random_rotation(seed):
    g = torch.Generator().manual_seed(seed)
    return se3.rotation(se3.exp(2 * torch.randn(6, generator=g, dtype=torch.float64))).numpy()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("flat", [False, True])
def test_finds_the_similarity_it_was_given(seed, flat):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(40, 3))
    if flat:
        source[:, 2] = 0.3 * source[:, 0]
    R, t = random_rotation(seed), rng.normal(size=3)
    found = umeyama(source, 2.5 * source @ R.T + t)
    assert found.note == ""
    assert found.scale == pytest.approx(2.5, rel=1e-12)
    np.testing.assert_allclose(found.R, R, atol=1e-12)
    np.testing.assert_allclose(found.t, t, atol=1e-12)


def test_rigid_alignment_keeps_the_scale():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(30, 3))
    found = umeyama(source, 3.0 * source, with_scale=False)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.R, np.eye(3), atol=1e-12)


def test_is_the_least_squares_optimum():
    rng = np.random.default_rng(7)
    source = rng.normal(size=(25, 3))
    target = 1.7 * source @ random_rotation(1).T + 0.3 * rng.normal(size=(25, 3))
    found = umeyama(source, target)

    def cost(scale, R, t):
        return float(((scale * source @ R.T + t - target) ** 2).sum())

    best = cost(found.scale, found.R, found.t)
    for seed in range(20):
        nudge = 1e-3 * np.random.default_rng(seed).normal(size=7)
        turn = se3.rotation(se3.exp(torch.tensor([0, 0, 0, *nudge[:3]]))).numpy()
        assert cost(found.scale * (1 + nudge[3]), turn @ found.R, found.t + nudge[4:]) >= best


@pytest.mark.parametrize("flat", [False, True])
def test_never_a_reflection(flat):
    rng = np.random.default_rng(2)
    source = rng.normal(size=(30, 3))
    if flat:
        source[:, 2] = 0
    found = umeyama(source, source * [1, 1, -1])
    assert np.linalg.det(found.R) == pytest.approx(1.0)
    assert found.scale > 0


def test_points_on_a_line():
    line = np.linspace(-1, 2, 9)[:, None] * np.array([[1.0, 2.0, -1.0]])
    R = random_rotation(3)
    found = umeyama(line, 2.0 * line @ R.T + 1.0)
    assert "line" in found.note
    assert np.linalg.det(found.R) == pytest.approx(1.0)
    np.testing.assert_allclose(found.apply(line), 2.0 * line @ R.T + 1.0, atol=1e-12)
    np.testing.assert_allclose(umeyama(line, -line).apply(line), -line, atol=1e-12)


@pytest.mark.parametrize("still", ["source", "target", "both"])
def test_points_that_coincide(still):
    moving = np.random.default_rng(0).normal(size=(8, 3))
    point = np.full((8, 3), 0.1)
    source = point if still in ("source", "both") else moving
    target = point if still in ("target", "both") else moving
    found = umeyama(source, target)
    assert "coincide" in found.note
    assert found.scale == 1.0
    assert np.isfinite(found.t).all()
    np.testing.assert_allclose(found.apply(source).mean(0), target.mean(0), atol=1e-12)


@pytest.mark.parametrize(
    ("source", "target", "says"),
    [
        (np.zeros((3, 3)), np.zeros((4, 3)), "one shape"),
        (np.zeros((3, 2)), np.zeros((3, 2)), "one shape"),
        (np.zeros((0, 3)), np.zeros((0, 3)), "at least one"),
        (np.full((3, 3), np.nan), np.zeros((3, 3)), "not finite"),
    ],
)
def test_bad_input_gets_a_sentence(source, target, says):
    with pytest.raises(InputError, match=says):
        umeyama(source, target)


def test_interpolation_ends_and_middle():
    g = torch.Generator().manual_seed(0)
    a, b = se3.exp(torch.randn(2, 6, 6, generator=g, dtype=torch.float64)).unbind(0)
    close = {"atol": 1e-12, "rtol": 0}
    torch.testing.assert_close(se3.matrix(interpolate(a, b, 0.0)), se3.matrix(a), **close)
    torch.testing.assert_close(se3.matrix(interpolate(a, b, 1.0)), se3.matrix(b), **close)
    half = interpolate(a, b, 0.5)
    again = interpolate(half, b, torch.full((6,), -1.0, dtype=torch.float64))
    torch.testing.assert_close(se3.matrix(again), se3.matrix(a), **close)


def test_interpolation_moves_at_constant_speed():
    v = torch.tensor([0.3, -0.1, 0.2, 0.1, 0.4, -0.2], dtype=torch.float64)
    a = se3.exp(torch.tensor([1.0, 2.0, 3.0, 0.3, 0.2, 0.1], dtype=torch.float64))
    s = torch.linspace(-0.5, 1.5, 7, dtype=torch.float64)
    expected = se3.mul(se3.exp(s[:, None] * v), a)
    got = interpolate(a, se3.retract(a, v), s)
    torch.testing.assert_close(got, expected, atol=1e-12, rtol=0)


def test_interpolation_between_equal_poses():
    a = se3.identity(3)
    assert torch.equal(interpolate(a, a, 0.3), a)
