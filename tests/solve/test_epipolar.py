"""Motion from matched points alone: distances, derivatives, and what a steady motion finds."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from droidw.geometry import se3
from droidw.solve.epipolar import (
    PointMatches,
    cost_of,
    disagreement,
    epipolar_distance,
    epipolar_term,
    led,
    planar_twin,
    steady_fit,
)

FOCAL = 200.0


def between(T):
    return se3.mul(T[1:], se3.inv(T[:-1]))


def rays(X):
    return X / X[..., 2:]


def matches(T, X, seen=None, gap=2):
    """Of points X [n,3] of the world between all poses up to `gap` apart."""
    ii, jj, here, there = [], [], [], []
    for i in range(len(T)):
        for j in range(i + 1, min(i + gap, len(T) - 1) + 1):
            a, b = rays(se3.act(T[i], X)), rays(se3.act(T[j], X))
            kept = torch.ones(len(X), dtype=bool) if seen is None else seen
            here.append(a[kept])
            there.append(b[kept])
            ii += [i] * int(kept.sum())
            jj += [j] * int(kept.sum())
    return PointMatches(
        torch.tensor(ii), torch.tensor(jj), torch.cat(here), torch.cat(there), FOCAL
    )


def some(count=40, seed=0):
    """Motions and rays that have nothing to do with each other."""
    g = torch.Generator().manual_seed(seed)
    T = se3.exp(0.3 * torch.randn(count, 6, generator=g, dtype=torch.float64))
    a, b = torch.rand(2, count, 2, generator=g, dtype=torch.float64) - 0.5
    one = torch.ones(count, 1, dtype=torch.float64)
    return T, torch.cat([a, one], dim=1), torch.cat([b, one], dim=1)


def test_points_that_stand_still_are_on_their_lines():
    T, a, _ = some()
    depth = 2.0 + torch.rand(len(a), 1, dtype=torch.float64)
    b = rays(se3.act(T, depth * a))
    assert epipolar_distance(T, a, b, FOCAL).abs().max() < 1e-9


def test_it_is_how_far_both_points_have_to_move():
    """Against the least movement that brings a pair onto an epipolar line, by optimisation."""
    T, a, _ = some()
    b = rays(se3.act(T, 3.0 * a))
    g = torch.Generator().manual_seed(1)
    b[:, :2] += 0.3 / FOCAL * torch.randn(len(b), 2, generator=g, dtype=torch.float64)
    found = epipolar_distance(T, a, b, FOCAL).abs()
    # Along the gradient of the distance times the root, both points move onto the line.
    both = torch.cat([a[:, :2], b[:, :2]], dim=1).requires_grad_()

    def residual(x):
        one = torch.ones(len(x), 1, dtype=torch.float64)
        p, q = torch.cat([x[:, :2], one], 1), torch.cat([x[:, 2:], one], 1)
        E = se3.skew(T[:, :3]) @ se3.rotation(T)
        return (q * (E @ p[..., None])[..., 0]).sum(1)

    x = both.detach().clone()
    for _ in range(10):
        x.requires_grad_()
        r = residual(x)
        (J,) = torch.autograd.grad(r.sum(), x)
        off = ((x - both.detach()) * J).sum(1)
        x = (both - ((r - off) / J.square().sum(1))[:, None] * J).detach()
    moved = FOCAL * (x - both.detach()).norm(dim=1)
    assert residual(x).abs().max() < 1e-10
    assert torch.allclose(found, moved, rtol=0.02, atol=1e-3)


def test_the_length_of_a_motion_does_not_matter():
    T, a, b = some()
    longer = torch.cat([7.0 * T[:, :3], T[:, 3:]], dim=1)
    assert torch.allclose(epipolar_distance(T, a, b, FOCAL), epipolar_distance(longer, a, b, FOCAL))


def test_derivatives_are_those_of_autograd():
    from droidw.solve import epipolar

    T, a, b = some()
    _, J = epipolar._measured(T, a, b, FOCAL)

    def distance(xi):
        return epipolar_distance(se3.mul(se3.exp(xi), T), a, b, FOCAL)

    zero = torch.zeros(len(T), 6, dtype=torch.float64)
    full = torch.autograd.functional.jacobian(distance, zero)
    row = torch.arange(len(T))
    assert torch.allclose(J, full[row, row], rtol=1e-9, atol=1e-9 * float(J.abs().max()))


def test_normal_equations_are_those_of_autograd():
    """The gradient of the energy, whose kernel is that of the weights."""
    from droidw.solve import epipolar

    T, found, _ = wall()
    motions = epipolar._as_long(between(T))
    g = torch.Generator().manual_seed(2)
    shaken = 0.01 * torch.randn(len(motions), 6, generator=g, dtype=torch.float64)
    motions = se3.mul(se3.exp(shaken), motions)
    _, gradient = epipolar._normal_equations(motions, found)

    def energy(xi):
        moved = se3.mul(se3.exp(xi), motions)
        T = led(moved)
        change = epipolar._changes(moved)
        return disagreement(T, found).sum() + change.square().sum()

    zero = torch.zeros(len(motions), 6, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(energy(zero), zero)
    # The rotation from one motion to the next counts as a difference: right to its square.
    assert torch.allclose(
        2 * gradient.reshape(-1, 6), slope, rtol=2e-2, atol=2e-2 * slope.abs().max()
    )


@pytest.fixture
def shaken():
    """Poses along a wall that are a little off, and the matches of that wall."""
    T, found, _ = wall()
    g = torch.Generator().manual_seed(3)
    off = 0.01 * torch.randn(len(T), 6, generator=g, dtype=torch.float64)
    return se3.mul(se3.exp(off), T), found


def test_a_term_of_poses_has_the_gradient_of_what_matches_cost(shaken):
    T, found = shaken
    term = epipolar_term(T, found, 3.0)

    def energy(xi):
        return 3.0 * disagreement(se3.mul(se3.exp(xi), T), found).sum()

    zero = torch.zeros(len(T), 6, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(energy(zero), zero)
    assert torch.allclose(-2 * term.rhs, slope, rtol=1e-8, atol=1e-8 * float(slope.abs().max()))


def test_a_term_of_poses_bends_as_weighed_distances_do(shaken):
    """The band against J^T W J of all distances, J by autograd."""
    T, found = shaken
    term = epipolar_term(T, found, 3.0)

    def distances(xi):
        moved = se3.mul(se3.exp(xi), T)
        T_ji = se3.mul(moved[found.jj], se3.inv(moved[found.ii]))
        return epipolar_distance(T_ji, found.here, found.there, FOCAL) / 0.2

    zero = torch.zeros(len(T), 6, dtype=torch.float64)
    J = torch.autograd.functional.jacobian(distances, zero).reshape(len(found), -1)
    kept = 3.0 / (1.0 + distances(zero).square())
    H = (J.T @ (kept[:, None] * J)).reshape(len(T), 6, len(T), 6).permute(0, 2, 1, 3)
    assert term.band.shape[1] == 3
    for m in range(len(T)):
        k = torch.arange(m, len(T))
        blocks = term.band[m:, m] if m < 3 else torch.zeros_like(H[k, k - m])
        assert torch.allclose(blocks, H[k, k - m], rtol=1e-8, atol=1e-8 * float(H.abs().max()))


def test_steps_by_points_alone_bring_a_path_to_them(shaken):
    T, found = shaken
    before = float(disagreement(T, found).sum())
    for _ in range(10):
        term = epipolar_term(T, found, 1.0)
        H = torch.zeros(len(T), len(T), 6, 6, dtype=torch.float64)
        for m in range(3):
            k = torch.arange(m, len(T))
            H[k, k - m], H[k - m, k] = term.band[m:, m], term.band[m:, m].mT
        H = H.permute(0, 2, 1, 3).reshape(6 * len(T), -1)
        x = torch.linalg.solve(H + 1e-3 * torch.eye(len(H)), term.rhs.reshape(-1))
        T = se3.mul(se3.exp(x.reshape(-1, 6)), T)
    assert float(disagreement(T, found).sum()) < 1e-3 * before


def test_terms_of_poses_add_up_whatever_their_widths(shaken):
    T, found = shaken
    near = found.within(0, len(T) - 1, 1)
    one, other = epipolar_term(T, near, 1.0), epipolar_term(T, found, 2.0)
    assert one.band.shape[1] < other.band.shape[1]
    g = torch.Generator().manual_seed(4)
    x = torch.randn(len(T), 6, generator=g, dtype=torch.float64)
    for both in (one + other, other + one):
        assert float(both.energy(x)) == pytest.approx(float(one.energy(x) + other.energy(x)))


def test_what_a_match_costs_is_told_in_fifths_of_a_pixel():
    assert cost_of(0.0) == 0.0
    assert cost_of(0.2) == pytest.approx(np.log(2))
    assert cost_of(1.0) == pytest.approx(np.log(26))


def test_matches_count_in_equal_parts_for_all_that_they_span():
    ray = torch.ones(3, 3, dtype=torch.float64)
    found = PointMatches(torch.tensor([0, 1, 1]), torch.tensor([1, 3, 2]), ray, ray, FOCAL)
    spread = found.spread(torch.tensor([5.0, 8.0, 1.0]), 5)
    assert spread.tolist() == [5.0, 5.0, 4.0, 0.0]


def test_matches_of_a_window():
    ray = torch.arange(4.0, dtype=torch.float64)[:, None].expand(4, 3)
    ends = torch.tensor([3, 4, 4, 5]), torch.tensor([4, 5, 7, 6])
    found = PointMatches(*ends, ray, ray, FOCAL).within(4, 6, 2)
    assert (found.ii.tolist(), found.jj.tolist()) == ([0, 1], [1, 2])
    assert found.here[:, 0].tolist() == [1.0, 3.0]


def wall(count=15, off_wall=16):
    """Poses along a wall, matches of few points, and poses of the twin of that motion."""
    normal, distance = np.array([0.8, 0.0, 0.6]), 2.0
    t = 0.1 * np.array([-0.6, 0.0, 0.8])
    motion = torch.tensor([*-t, 0, 0, 0, 1.0], dtype=torch.float64)
    T = led(motion.expand(count - 1, 7))
    random = np.random.default_rng(0)
    a = np.c_[random.uniform(-0.7, 0.7, (40, 2)), np.ones(40)]
    X = torch.from_numpy(a * (distance / (a @ normal))[:, None])
    X[:off_wall] *= torch.from_numpy(random.uniform(0.6, 0.9, (off_wall, 1)))
    X = X[(X[:, 2] > 0) & (X[:, 2] < 10)] + torch.from_numpy(7 * t)
    H = np.eye(3) + np.outer(-t, normal) / distance
    _, R, ts, ns = cv2.decomposeHomographyMat(H, np.eye(3))
    twins = [
        (r, s.ravel() * distance)
        for r, s, n in zip(R, ts, ns, strict=True)
        if np.abs(r - np.eye(3)).max() > 1e-3 and n[2, 0] > 0
    ]
    assert twins
    turned = [
        torch.from_numpy(np.block([[r, s[:, None]], [np.zeros((1, 3)), 1]])) for r, s in twins
    ]
    twin = led(se3.from_matrix(turned[0]).expand(count - 1, 7))
    return T, matches(T, X), twin


def angle(motions, T):
    return torch.rad2deg(se3.log(se3.mul(motions, se3.inv(between(T))))[:, 3:].norm(dim=1))


def test_a_wall_alone_is_explained_by_the_twin_of_the_motion():
    """Between neighbours, to first order: this is why a path may stay there."""
    T, _, twin = wall()
    _, found, _ = wall(off_wall=0)
    near = found.within(0, len(T) - 1, 1)
    assert disagreement(twin, near).mean() < 0.02
    assert angle(between(twin), T).min() > 1.0


NORMAL = torch.tensor([0.8, 0.0, 0.6], dtype=torch.float64)


def test_the_twin_of_a_motion_before_a_plane():
    T, _, twin = wall()
    found = planar_twin(between(T), (NORMAL / 2.0).expand(len(T) - 1, 3))
    # To first order: motions of 0.1 before a wall 2 away.
    assert angle(found, twin).max() < 0.1
    assert torch.allclose(found[:, :3], between(twin)[:, :3], atol=1e-2)


def test_the_twin_of_the_twin_is_the_motion():
    T, _, _ = wall()
    motions, planes = between(T), (NORMAL / 2.0).expand(len(T) - 1, 3)
    once = planar_twin(motions, planes)
    # in front of the camera, which goes ahead
    normals = -motions[:, :3] / motions[:, :3].norm(dim=1, keepdim=True) / 2.0
    again = planar_twin(once, normals)
    assert torch.allclose(again, motions, atol=2e-3)


@pytest.mark.parametrize("wrong", [0.0, 0.15])
def test_few_points_tell_a_steady_motion_from_its_twin(wrong):
    T, found, twin = wall()
    random = np.random.default_rng(1)
    astray = torch.from_numpy(random.random(len(found)) < wrong)
    there = found.there.clone()
    there[astray, :2] += 0.1 * torch.from_numpy(random.standard_normal((int(astray.sum()), 2)))
    found = PointMatches(found.ii, found.jj, found.here, there, FOCAL)
    normals = torch.tensor([-0.6, 0.0, 0.8], dtype=torch.float64)
    start = planar_twin(between(twin), (normals / 2.0).expand(len(T) - 1, 3))
    motions = steady_fit(start, found)
    assert angle(motions, T).max() < 0.3
    assert torch.allclose(motions[:, :3].norm(dim=1), start[:, :3].norm(dim=1))
    stayed = steady_fit(between(twin), found)
    cost = disagreement(led(motions), found).sum()
    assert cost < 0.75 * disagreement(led(stayed), found).sum()


def test_a_steady_motion_leaves_what_is_wrong_without_a_wall():
    T, found, _ = wall(off_wall=40)
    off = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.02, 0.01], dtype=torch.float64)
    motions = steady_fit(se3.mul(se3.exp(off.expand(len(T) - 1, 6)), between(T)), found)
    assert angle(motions, T).max() < 0.1


def test_what_is_right_stays():
    T, found, _ = wall()
    assert angle(steady_fit(between(T), found), T).max() < 1e-3
