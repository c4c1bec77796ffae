"""Projection between frames: against plain loops, autograd and finite differences."""

from __future__ import annotations

import math

import pytest
import torch

from droidw.geometry import projective, se3

K = torch.tensor([9.0, 10.0, 4.2, 2.7], dtype=torch.float64)


@pytest.fixture
def scene():
    g = torch.Generator().manual_seed(1)
    T_cw = se3.exp(0.15 * torch.randn(5, 6, generator=g, dtype=torch.float64))
    disps = 0.3 + torch.rand(5, 6, 8, generator=g, dtype=torch.float64)
    return T_cw, disps, torch.tensor([0, 1, 2, 4, 3]), torch.tensor([1, 3, 0, 2, 3])


def project_one(T_cw, disps, i, j, y, x):
    """One cell, by 4x4 matrices: (u, v, relative depth)."""
    G = se3.matrix(T_cw[j]) @ torch.linalg.inv(se3.matrix(T_cw[i]))
    ray = torch.tensor([(x - K[2]) / K[0], (y - K[3]) / K[1], 1.0, float(disps[i, y, x])])
    X = G @ ray.double()
    return K[0] * X[0] / X[2] + K[2], K[1] * X[1] / X[2] + K[3], X[2]


def test_pixel_grid_is_x_then_y():
    grid = projective.pixel_grid(2, 3)
    assert grid.shape == (2, 3, 2)
    assert grid[1, 2].tolist() == [2.0, 1.0]


def test_reproject_against_a_loop(scene):
    T_cw, disps, ii, jj = scene
    coords, valid = projective.reproject(T_cw, disps, K, ii, jj)
    assert coords.shape == (5, 6, 8, 2)
    assert coords.is_contiguous()
    assert valid.dtype == torch.bool
    for e in range(5):
        for y, x in [(0, 0), (5, 7), (2, 3)]:
            u, v, z = project_one(T_cw, disps, int(ii[e]), int(jj[e]), y, x)
            assert bool(valid[e, y, x]) == bool(z >= 0.25)
            assert coords[e, y, x].tolist() == pytest.approx([float(u), float(v)], abs=1e-12)


def test_a_frame_onto_itself_is_the_identity(scene):
    T_cw, disps, _, _ = scene
    coords, valid = projective.reproject(T_cw, disps, K, torch.tensor([3]), torch.tensor([3]))
    grid = projective.pixel_grid(6, 8, torch.float64)
    torch.testing.assert_close(coords[0], grid, atol=1e-13, rtol=0)
    assert valid.all()


@pytest.mark.parametrize("z", [-5.0, -1.0, -0.8, -0.7500001])
def test_points_behind_or_close_are_invalid_and_finite(z):
    T_cw = se3.identity(2, dtype=torch.float64)
    T_cw[1, 2] = z  # moves points of depth 1 to 1 + z
    disps = torch.ones(2, 4, 5, dtype=torch.float64)
    ij = torch.tensor([0]), torch.tensor([1])
    coords, valid = projective.reproject(T_cw, disps, K, *ij)
    assert torch.isfinite(coords).all()
    assert not valid.any()
    for J in projective.jacobians(T_cw, disps, K, *ij):
        assert torch.equal(J, torch.zeros_like(J))


def test_near_test_is_relative():
    T_cw = se3.identity(2, dtype=torch.float64)
    T_cw[1, 2] = -70.0
    disps = torch.full((2, 2, 2), 0.01, dtype=torch.float64)  # depth 100 becomes 30: ratio 0.3
    _, valid = projective.reproject(T_cw, disps, K, torch.tensor([0]), torch.tensor([1]))
    assert valid.all()


def test_jacobians_against_autograd(scene):
    T_cw, disps, ii, jj = scene
    ii, jj = ii[:4], jj[:4]

    def f(xi, d):
        return projective.reproject(se3.retract(T_cw, xi), d, K, ii, jj)[0]

    zero = torch.zeros(5, 6, dtype=torch.float64)
    J_x, J_d = torch.autograd.functional.jacobian(f, (zero, disps))
    J_i, J_j, J_z = projective.jacobians(T_cw, disps, K, ii, jj)
    for e in range(4):
        i, j = int(ii[e]), int(jj[e])
        torch.testing.assert_close(J_i[e], J_x[e, ..., i, :], atol=1e-10, rtol=0)
        torch.testing.assert_close(J_j[e], J_x[e, ..., j, :], atol=1e-10, rtol=0)
        for y, x in [(0, 0), (5, 7), (3, 4)]:
            torch.testing.assert_close(J_z[e, y, x], J_d[e, y, x, :, i, y, x], atol=1e-10, rtol=0)


def test_jacobians_against_finite_differences(scene):
    T_cw, disps, ii, jj = scene
    ii, jj = ii[:4], jj[:4]
    J_i, J_j, J_z = projective.jacobians(T_cw, disps, K, ii, jj)
    step = 1e-5

    def f(T, d):
        return projective.reproject(T, d, K, ii, jj)[0]

    for e in range(4):
        for frame, J in ((int(ii[e]), J_i), (int(jj[e]), J_j)):
            for k in range(6):
                xi = torch.zeros(5, 6, dtype=torch.float64)
                xi[frame, k] = step
                plus, minus = f(se3.retract(T_cw, xi), disps), f(se3.retract(T_cw, -xi), disps)
                numeric = ((plus - minus) / (2 * step))[e]
                torch.testing.assert_close(J[e, ..., k], numeric, atol=1e-6, rtol=1e-6)
    numeric = (f(T_cw, disps + step) - f(T_cw, disps - step)) / (2 * step)
    torch.testing.assert_close(J_z, numeric, atol=1e-6, rtol=1e-6)


def plain_distance(T_cw, disps, i, j, beta):
    total = weight = 0.0
    G = se3.matrix(T_cw[j]) @ torch.linalg.inv(se3.matrix(T_cw[i]))
    h, w = disps.shape[1:]
    for y in range(h):
        for x in range(w):
            d = float(disps[i, y, x])
            ray = torch.tensor([(x - K[2]) / K[0], (y - K[3]) / K[1], 1.0]).double()
            for share, X in (
                (beta, G[:3, :3] @ ray + d * G[:3, 3]),
                (1.0 - beta, ray + d * G[:3, 3]),
            ):
                if X[2] > 0.25:
                    u, v = K[0] * X[0] / X[2] + K[2], K[1] * X[1] / X[2] + K[3]
                    total += share * math.hypot(float(u) - x, float(v) - y)
                    weight += share
    return 1000.0 if weight / (h * w) < 0.75 else total / weight


@pytest.mark.parametrize("beta", [0.0, 0.25, 0.75, 1.0])
def test_frame_distance_against_a_loop(scene, beta):
    T_cw, disps, ii, jj = scene
    T_cw = T_cw.clone()
    T_cw[2, 2] -= 0.7  # pushes cells of some edges through the near plane
    one_way = projective.frame_distance(T_cw, disps, K, ii, jj, beta, bidirectional=False)
    both = projective.frame_distance(T_cw, disps, K, ii, jj, beta)
    for e in range(5):
        i, j = int(ii[e]), int(jj[e])
        there = plain_distance(T_cw, disps, i, j, beta)
        back = plain_distance(T_cw, disps, j, i, beta)
        assert float(one_way[e]) == pytest.approx(there, rel=1e-9, abs=1e-9)
        assert float(both[e]) == pytest.approx(0.5 * (there + back), rel=1e-9, abs=1e-9)


def test_frame_distance_says_far_when_too_little_can_be_compared(scene):
    _, disps, _, _ = scene
    T_cw = se3.identity(5, dtype=torch.float64)
    T_cw[1, 2] = -50.0
    ij = torch.tensor([0, 0]), torch.tensor([1, 2])
    distance = projective.frame_distance(T_cw, disps, K, *ij, 0.5, bidirectional=False)
    assert distance.tolist() == [projective.FAR_DISTANCE, 0.0]


def test_frame_distance_in_parts_is_the_same(scene, monkeypatch):
    T_cw, disps, ii, jj = scene
    whole = projective.frame_distance(T_cw, disps, K, ii, jj, 0.4)
    monkeypatch.setattr(projective, "_CHUNK_CELLS", 100)
    torch.testing.assert_close(
        projective.frame_distance(T_cw, disps, K, ii, jj, 0.4), whole, atol=1e-13, rtol=0
    )


def test_no_edges(scene):
    T_cw, disps, _, _ = scene
    none = torch.zeros(0, dtype=torch.int64)
    coords, valid = projective.reproject(T_cw, disps, K, none, none)
    assert coords.shape == (0, 6, 8, 2)
    assert valid.shape == (0, 6, 8)
    assert projective.frame_distance(T_cw, disps, K, none, none, 0.5).shape == (0,)


def test_single_precision_is_close(scene):
    T_cw, disps, ii, jj = scene
    exact, _ = projective.reproject(T_cw, disps, K, ii, jj)
    coords, _ = projective.reproject(T_cw.float(), disps.float(), K.float(), ii, jj)
    assert coords.dtype == torch.float32
    torch.testing.assert_close(coords.double(), exact, atol=2e-5, rtol=0)
