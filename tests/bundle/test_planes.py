"""Planes along the axes: found in a room, and cells held to them by every backend."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.geometry import se3
from droidw.geometry.projective import reproject, viewing_rays
from droidw.solve.planes import Plane, find_planes, held_to_planes
from droidw.solve.problem import BAProblem, PoseTerm

H, W, COUNT, HALF = 18, 24, 8, 3
INTRINSICS = torch.tensor([12.0, 12.5, 11.3, 8.7], dtype=torch.float64)
# walls at both ends of each axis, with a camera inside
LOW, HIGH = (torch.tensor(w, dtype=torch.float64) for w in ([-2.0, -1.5, -4.0], [2.5, 1.2, 9.0]))
UPRIGHT = se3.rotation(se3.exp(torch.tensor([0, 0, 0, 0.3, -0.5, 0.2], dtype=torch.float64)))


def room():
    """Poses [N,7] of a camera that goes through a room of six walls, and its disparities."""
    s = torch.arange(COUNT, dtype=torch.float64)
    turn = torch.stack([0.02 * s.sin(), 0.06 * s, 0.02 * s.cos()], dim=1)
    turns = se3.rotation(se3.exp(torch.cat([torch.zeros(COUNT, 3).double(), turn], dim=1)))
    place = torch.stack([0.2 * s.sin(), 0.1 * s.cos(), 0.5 * s], dim=1)
    R = turns @ UPRIGHT.mT
    pose = torch.cat([R, -(R @ (place @ UPRIGHT.mT)[..., None])], dim=2)
    rays = viewing_rays(H, W, INTRINSICS).view(-1, 3) @ turns
    reach = torch.where(rays > 0, HIGH - place[:, None], LOW - place[:, None]) / rays
    return se3.from_matrix(pose), reach.amin(-1).reciprocal().view(COUNT, H, W)


def matches(T_cw, disps, edges, **changes):
    """A problem whose matches say these poses and depths."""
    ii, jj = torch.tensor(edges).T.contiguous()
    target, valid = reproject(T_cw, disps, INTRINSICS, ii, jj)
    fixed = torch.arange(len(T_cw)) == 0
    problem = BAProblem(
        T_cw=T_cw, disps=disps, intrinsics=INTRINSICS, ii=ii, jj=jj, target=target,
        weight=valid[..., None].double().expand(-1, -1, -1, 2).clone(), fixed=fixed,
        damping=torch.full_like(disps, 1e-9), lm=1e-9, ep=1e-9, pairs=edges,
    )  # fmt: skip
    return replace(problem, **changes)


def neighbours(first, last, reach=3, avoid=()):
    return [
        (i, j)
        for i in range(first, last)
        for j in range(first, last)
        if 0 < abs(i - j) <= reach and i not in avoid
    ]


def in_two_pieces(times):
    """The path behind keyframe HALF `times` as large, and no match says how large it is."""
    T_cw, disps = room()
    centres = se3.inv(T_cw)
    at = centres[HALF, :3]
    centres[HALF:, :3] = at + times * (centres[HALF:, :3] - at)
    disps[HALF + 1 :] /= times
    T_cw = se3.inv(centres)
    edges = neighbours(0, HALF + 1) + neighbours(HALF, COUNT, avoid=(HALF,))
    fixed = torch.arange(COUNT) <= 1  # the scale of the first piece is given
    return matches(T_cw, disps, edges, fixed=fixed)


def scale_behind(T_cw):
    """Of the piece behind HALF, against the truth."""
    centres, true = se3.inv(T_cw.double())[:, :3], se3.inv(room()[0])[:, :3]
    return float((centres[-1] - centres[HALF]).norm() / (true[-1] - true[HALF]).norm())


def solve(backend, problem, weight, steps, open_=None):
    adjuster = backend()
    open_ = torch.ones_like(problem.disps) if open_ is None else open_
    for _ in range(steps):
        upright = UPRIGHT.to(problem.T_cw.device)
        result = adjuster.step(held_to_planes(problem, upright, open_, weight))
        assert result.report.status == "ok"
        problem = replace(problem, T_cw=result.T_cw[:COUNT], disps=result.disps[:COUNT])
    return problem


def test_walls_are_found_where_they_are():
    T_cw, disps = room()
    found = find_planes(T_cw, disps, INTRINSICS, UPRIGHT, torch.ones_like(disps))
    # the wall behind the camera is not seen
    true = {(a, float(w[a])) for a in range(3) for w in (LOW, HIGH)} - {(2, -4.0)}
    assert {(p.axis, round(p.offset, 2)) for p in found} == true
    assert all(p.share > 0.05 for p in found)
    for axis in range(3):
        shares = [p.share for p in found if p.axis == axis]
        assert shares == sorted(shares, reverse=True)


def test_what_is_closed_or_far_is_no_plane():
    T_cw, disps = room()
    nothing = torch.zeros_like(disps)
    assert find_planes(T_cw, disps, INTRINSICS, UPRIGHT, nothing) == []
    problem = matches(T_cw, disps, neighbours(0, COUNT))
    assert held_to_planes(problem, UPRIGHT, nothing, 1.0) is problem
    # 600 times as far, the walls are nothing to go by
    far = torch.where(torch.arange(H)[:, None] < H // 2, disps / 600, disps)
    found = find_planes(T_cw, far, INTRINSICS, UPRIGHT, torch.ones_like(disps))
    assert all(abs(p.offset) < 10 for p in found)
    nowhere = torch.where(torch.arange(H)[:, None] < H // 2, torch.zeros_like(disps), disps)
    held = held_to_planes(replace(problem, disps=nowhere), UPRIGHT, torch.ones_like(disps), 1.0)
    assert len(held.T_cw) > COUNT
    assert bool(torch.isfinite(held.weight).all())


def test_a_cell_costs_what_it_is_off():
    """Energy of the added edges against the formula, cell by cell."""
    T_cw, disps = room()
    g = torch.Generator().manual_seed(0)
    disps = disps * (1 + 0.004 * torch.randn(disps.shape, generator=g, dtype=torch.float64))
    open_ = torch.rand(disps.shape, generator=g, dtype=torch.float64)
    problem = matches(T_cw, disps, neighbours(0, COUNT))
    held = held_to_planes(problem, UPRIGHT, open_, 0.7)
    planes = find_planes(T_cw, disps, INTRINSICS, UPRIGHT, open_)
    assert len(held.T_cw) == COUNT + len(planes)
    assert bool(held.fixed[COUNT:].all())
    E = len(problem.ii)
    assert held.pairs[E:] == list(zip(held.ii[E:].tolist(), held.jj[E:].tolist(), strict=True))
    assert torch.equal(held.target[:E], problem.target)
    coords, valid = reproject(held.T_cw, held.disps, INTRINSICS, held.ii, held.jj)
    assert bool(valid[E:][held.weight[E:, ..., 1] > 0].all())
    energy = (held.weight * (held.target - coords).square())[E:].sum(-1)

    depth = disps.reciprocal()
    points = torch.einsum(
        "nji,nhwj->nhwi", se3.rotation(T_cw), viewing_rays(H, W, INTRINSICS) * depth[..., None]
    )
    points = (points + se3.inv(T_cw)[:, None, None, :3]) @ UPRIGHT
    off = torch.stack([points[..., p.axis] - p.offset for p in planes])
    median = depth[open_ > 0.5].median()
    width = 0.01 * depth.clamp_min(0.3 * median)
    off, nearest = off.abs().min(0)
    square = (off / width).square()
    used = open_ * (depth < 3 * median)
    expected = 0.7 * used * square / (1 + square).square()
    # a plane of which a keyframe sees less than ten cells is left alone there
    for k in range(len(planes)):
        few = ((nearest == k) & (used > 0)).flatten(1).sum(1) < 10
        expected[few[:, None, None] & (nearest == k)] = 0.0
    total = torch.zeros(COUNT, H, W, dtype=torch.float64).index_add_(0, held.ii[E:], energy)
    torch.testing.assert_close(total, expected, rtol=1e-6, atol=1e-9)


def test_a_plane_reaches_as_far_as_the_path():
    T_cw, disps = room()
    centres = se3.inv(T_cw)
    centres[HALF:, :3] += 500.0 * UPRIGHT[:, 2]
    problem = matches(se3.inv(centres), disps, neighbours(0, COUNT))
    held = held_to_planes(problem, UPRIGHT, torch.ones_like(disps), 1.0)
    _, valid = reproject(held.T_cw, held.disps, INTRINSICS, held.ii, held.jj)
    added = slice(len(problem.ii), None)
    weighs = held.weight[added, ..., 1] > 0
    assert bool(valid[added][weighs].all())
    assert set(held.ii[added].tolist()) == set(range(COUNT))


def test_what_else_is_known_of_poses_stays():
    T_cw, disps = room()
    g = torch.Generator().manual_seed(0)
    term = PoseTerm(torch.rand(COUNT, 2, 6, 6, generator=g).double(), torch.ones(COUNT, 6).double())
    problem = matches(T_cw, disps, neighbours(0, COUNT), pose_term=term, prior=0.5 * disps)
    held = held_to_planes(problem, UPRIGHT, torch.ones_like(disps), 1.0)
    more = len(held.T_cw) - COUNT
    held.pose_term.check(COUNT + more)
    assert torch.equal(held.pose_term.band[:COUNT], term.band)
    assert not bool(held.pose_term.band[COUNT:].any())
    assert torch.equal(held.prior[:COUNT], problem.prior)
    assert not bool(held.prior[COUNT:].any())
    crossed = replace(problem, weight=torch.nn.functional.pad(problem.weight, (0, 1)))
    assert held_to_planes(crossed, UPRIGHT, torch.ones_like(disps), 1.0).channels == 3


def test_a_piece_that_is_too_large_finds_back_to_the_floor(backend):
    problem = in_two_pieces(1.01)
    assert scale_behind(problem.T_cw) == pytest.approx(1.01)
    alone = solve(backend, problem, 0.0, 6)
    assert scale_behind(alone.T_cw) == pytest.approx(1.01, abs=1e-4)
    held = solve(backend, problem, 1e-4, 12)
    assert scale_behind(held.T_cw) == pytest.approx(1.0, abs=1e-3)


def test_what_moves_along_is_not_held(backend):
    """A box in front of the floor, closed, is no plane, though half of the floor is behind it."""
    problem = in_two_pieces(1.01)
    disps, open_ = problem.disps.clone(), torch.ones_like(problem.disps)
    disps[:, H // 2 :, : W // 2] = 1.0
    open_[:, H // 2 :, : W // 2] = 0.0
    ii, jj = problem.ii, problem.jj
    weight = problem.weight * open_[ii][..., None]
    held = solve(backend, replace(problem, disps=disps, weight=weight), 1e-4, 12, open_)
    assert scale_behind(held.T_cw) == pytest.approx(1.0, abs=2e-3)
    assert len(jj) == len(held.jj)


def test_backends_agree(backend):
    problem = in_two_pieces(1.01)
    g = torch.Generator().manual_seed(1)
    noise = torch.randn(problem.target.shape, generator=g, dtype=torch.float64)
    problem = replace(problem, target=problem.target + 0.02 * noise, ep=1e-4)
    held = held_to_planes(problem, UPRIGHT, torch.ones_like(problem.disps), 1e-3)
    check(held, backend().step(held))


@pytest.mark.gpu
def test_a_gpu_agrees(backends, cast):
    there = cast(in_two_pieces(1.01), torch.float32, "cuda")
    held = solve(backends["cuda"], there, 1e-4, 12, torch.ones_like(there.disps))
    assert scale_behind(held.T_cw.cpu()) == pytest.approx(1.0, abs=2e-3)


def check(problem, found):
    from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

    expected = TorchBundleAdjuster().step(problem)
    assert found.report.status == expected.report.status == "ok"
    torch.testing.assert_close(found.T_cw, expected.T_cw, rtol=0, atol=1e-7)
    torch.testing.assert_close(found.disps, expected.disps, rtol=1e-5, atol=1e-6)
    assert torch.equal(found.T_cw[COUNT:], problem.T_cw[COUNT:])


def test_planes_say_which_axes_lie_in_them():
    for axis in range(3):
        plane = Plane(axis, 0.0, 1.0)
        assert sorted([plane.axis, plane.along, plane.across]) == [0, 1, 2]
        eye = torch.eye(3)[[plane.across, plane.axis, plane.along]]
        assert float(torch.linalg.det(eye)) == 1.0
