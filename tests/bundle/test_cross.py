"""Information with an off-diagonal part: derivatives, limits, and what rounding may do to it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.geometry import projective, se3


def energy(p, xi, disps):
    """The energy as `BAProblem` says it, of poses moved by tangents [N,6] and of disparities."""
    T_cw = se3.retract(p.T_cw, xi)
    coords, valid = projective.reproject(T_cw, disps, p.intrinsics, p.ii, p.jj)
    x, y = (p.target - coords).unbind(-1)
    xx, yy, xy = (p.weight * valid[..., None]).unbind(-1)
    cells = xx * x * x + 2 * xy * x * y + yy * y * y
    if p.huber is not None:
        mean = 0.5 * (xx + yy)
        length = (cells / mean.clamp_min(1e-300)).clamp_min(1e-300).sqrt()
        outside = mean * (2 * p.huber * length - p.huber**2)
        cells = torch.where(length > p.huber, outside, cells)
    return cells.sum()


HUBER = pytest.mark.parametrize("huber", [None, 0.1])


@HUBER
def test_the_step_follows_the_gradient_by_autograd(make, step, huber):
    # damping so strong that what is left of the step is the gradient
    much = 1e10
    p, _, _ = make(noise=0.02, cross=True, huber=huber, lm=0.0, ep=much)
    p = replace(p, damping=torch.full_like(p.disps, much), min_disp=0.0)
    xi = torch.zeros(len(p.T_cw), 6, dtype=torch.float64, requires_grad=True)
    disps = p.disps.clone().requires_grad_(True)
    energy(p, xi, disps).backward()
    got = step(p)
    assert got.report.status == "ok"
    moved = se3.log(se3.mul(got.T_cw, se3.inv(p.T_cw)))
    for found, gradient in ((moved, xi.grad), (got.disps - p.disps, disps.grad)):
        expected = -0.5 * gradient
        expected[p.fixed if found is moved else []] = 0.0
        size = float(expected.abs().max())
        assert size > 0.1
        # 1e-16 of the numbers near 1 that the step is added to, and curvature over damping
        torch.testing.assert_close(found * much, expected, atol=1e-4 * max(size, 1.0), rtol=0)


@HUBER
def test_the_reported_energy_changes_as_its_gradient_says(make, step, huber):
    p, _, _ = make(noise=0.02, cross=True, huber=huber)
    g = torch.Generator().manual_seed(4)
    along_xi = torch.randn(len(p.T_cw), 6, generator=g, dtype=torch.float64)
    along_d = torch.randn(p.disps.shape, generator=g, dtype=torch.float64)
    xi = torch.zeros_like(along_xi, requires_grad=True)
    disps = p.disps.clone().requires_grad_(True)
    energy(p, xi, disps).backward()
    slope = float((xi.grad * along_xi).sum() + (disps.grad * along_d).sum())

    def reported(t):
        moved = replace(p, T_cw=se3.retract(p.T_cw, t * along_xi), disps=p.disps + t * along_d)
        return step(moved).report.cost_before

    t = 1e-5
    assert (reported(t) - reported(-t)) / (2 * t) == pytest.approx(slope, rel=1e-5)


@HUBER
@pytest.mark.parametrize("guard", [False, True])
def test_without_an_off_diagonal_it_is_the_step_of_two_weights(make, step, huber, guard):
    p, _, _ = make(noise=0.02, huber=huber, guard=guard)
    zero = torch.zeros_like(p.weight[..., :1])
    expected, got = step(p), step(replace(p, weight=torch.cat((p.weight, zero), dim=-1)))
    assert got.report.cost_before == pytest.approx(expected.report.cost_before, rel=1e-12)
    torch.testing.assert_close(got.T_cw, expected.T_cw, atol=1e-11, rtol=0)
    torch.testing.assert_close(got.disps, expected.disps, atol=1e-10, rtol=0)


def test_measured_along_the_slant_alone_nothing_is_said_across(make, step):
    # all matches slip along the same direction, along which nothing is known
    p, _, _ = make(noise=0.01)
    normal = torch.tensor([0.6, 0.8], dtype=torch.float64)
    known = normal[:, None] * normal
    weight = torch.stack((known[0, 0], known[1, 1], known[0, 1])).expand(*p.target.shape[:-1], 3)
    slip = torch.randn(p.target.shape[:-1], generator=torch.Generator().manual_seed(2)).double()
    slipped = p.target + slip[..., None] * torch.tensor([-0.8, 0.6], dtype=torch.float64)
    expected = step(replace(p, weight=weight.contiguous()))
    got = step(replace(p, weight=weight.contiguous(), target=slipped))
    assert got.report.status == "ok"
    assert got.report.cost_before == pytest.approx(expected.report.cost_before, rel=1e-9)
    torch.testing.assert_close(got.T_cw, expected.T_cw, atol=1e-8, rtol=0)
    torch.testing.assert_close(got.disps, expected.disps, atol=1e-7, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_rounding_beyond_the_cone_counts_as_none(make, step, dtype):
    p, _, _ = make(noise=0.02, dtype=dtype)
    xy = p.weight.prod(-1).sqrt()
    edge = torch.cat((p.weight, xy[..., None]), dim=-1)
    beyond = torch.cat((p.weight, xy[..., None] * (1 + 8 * torch.finfo(dtype).eps)), dim=-1)
    expected, got = step(replace(p, weight=edge)), step(replace(p, weight=beyond))
    assert got.report.status == expected.report.status == "ok"
    near = 1e-9 if dtype == torch.float64 else 1e-3
    torch.testing.assert_close(got.T_cw, expected.T_cw, atol=near, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_information_along_x_that_all_but_vanishes_is_not_divided_by(make, step, dtype):
    p, _, _ = make(noise=0.02, dtype=dtype)
    weight = torch.cat((p.weight, torch.zeros_like(p.weight[..., :1])), dim=-1)
    weight[::2, ..., 0] = 0.0
    expected = step(replace(p, weight=weight))
    tiny = weight.clone()
    tiny[::2, ..., 0] = 4 * torch.finfo(dtype).tiny
    tiny[::2, ..., 2] = 2 * (torch.finfo(dtype).tiny * tiny[::2, ..., 1]).sqrt()
    got = step(replace(p, weight=tiny))
    assert got.report.status == expected.report.status == "ok"
    assert got.report.dropped == 0
    torch.testing.assert_close(got.T_cw, expected.T_cw, atol=1e-6, rtol=0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("guard", [False, True])
def test_a_cross_term_that_is_not_finite_is_dropped(make, step, value, guard):
    p, _, _ = make(noise=0.02, cross=True, huber=0.3, guard=guard)
    broken, without = p.weight.clone(), p.weight.clone()
    broken[1, 2, 3, 2] = broken[4, 0, 0, 2] = value
    without[1, 2, 3] = without[4, 0, 0] = 0.0
    expected, got = step(replace(p, weight=without)), step(replace(p, weight=broken))
    assert got.report.status == "ok"
    assert got.report.dropped == 2
    torch.testing.assert_close(got.T_cw, expected.T_cw, atol=1e-11, rtol=0)
    torch.testing.assert_close(got.disps, expected.disps, atol=1e-10, rtol=0)


def test_other_numbers_of_channels_are_refused(make, backends):
    p, _, _ = make()
    for name in ("native", "host"):
        for channels in (1, 4):
            wrong = p.weight[..., :1].expand(*p.weight.shape[:-1], channels)
            with pytest.raises(ValueError, match="weight"):
                backends[name]().step(replace(p, weight=wrong))


def test_one_adjuster_takes_both_kinds_in_turn(make, backend, step):
    two, _, _ = make(noise=0.02)
    three, _, _ = make(noise=0.02, cross=True)
    adjuster = backend()
    for p in (two, three, two, three):
        got, fresh = adjuster.step(p), step(p)
        assert torch.equal(got.T_cw, fresh.T_cw)
        assert torch.equal(got.disps, fresh.disps)
