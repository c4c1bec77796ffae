"""What cannot be solved is reported and never propagated."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.geometry import projective

NAN, INF = float("nan"), float("inf")


def assert_unchanged(result, problem):
    assert torch.equal(result.T_cw, problem.T_cw)
    assert torch.equal(result.disps, problem.disps)


def assert_finite(result):
    assert torch.isfinite(result.T_cw).all()
    assert torch.isfinite(result.disps).all()


@pytest.mark.parametrize("field", ["target", "weight"])
@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("guard", [False, True])
def test_measurements_that_are_not_finite_are_dropped_and_counted(make, field, value, guard, step):
    if field == "weight" and value == -INF:
        value = NAN
    p, _, _ = make(noise=0.02, guard=guard)
    cells = [(0, 1, 2), (3, 0, 0), (7, 5, 7)]
    broken, weight = getattr(p, field).clone(), p.weight.clone()
    for k, cell in enumerate(cells):
        broken[(*cell, k % 2)] = value
        weight[cell] = 0.0
    got = step(replace(p, **{field: broken}))
    expected = step(replace(p, weight=weight))
    assert got.report.status == "ok"
    assert got.report.dropped == 3
    assert expected.report.dropped == 0
    assert torch.equal(got.T_cw, expected.T_cw)
    assert torch.equal(got.disps, expected.disps)


@pytest.mark.parametrize("cross", [False, True])
def test_a_weight_that_rounding_made_negative_costs_its_match_and_no_other(make, cross, step):
    p, _, _ = make(noise=0.02, huber=0.3, cross=cross)
    broken, without = p.weight.clone(), p.weight.clone()
    without[3, 2, 1] = broken[3, 2, 1] = 0.0
    broken[3, 2, 1, 0] = -1e-19
    expected, got = step(replace(p, weight=without)), step(replace(p, weight=broken))
    assert got.report.status == "ok"
    assert got.report.dropped == 1
    assert torch.equal(got.T_cw, expected.T_cw)
    assert torch.equal(got.disps, expected.disps)


def test_nothing_but_nan(make, step):
    p, _, _ = make(noise=0.02)
    p = replace(p, target=torch.full_like(p.target, NAN))
    got = step(p)
    assert got.report.status == "empty"
    assert got.report.dropped == p.target[..., 0].numel()
    assert got.report.isolated == (1, 2, 3, 4)
    assert_unchanged(got, p)


def test_a_frame_without_edges_is_held_and_named(make, step):
    p, _, _ = make(noise=0.02)
    keep = (p.ii != 3) & (p.jj != 3)
    p = replace(
        p, ii=p.ii[keep], jj=p.jj[keep], target=p.target[keep], weight=p.weight[keep], lm=0.0
    )
    for ep in (0.1, 1e-6):
        got = step(replace(p, ep=ep))
        assert got.report.status == "ok"
        assert got.report.isolated == (3,)
        assert torch.equal(got.T_cw[3], p.T_cw[3])
        assert torch.equal(got.disps[3], p.disps[3])
        assert not torch.equal(got.T_cw[2], p.T_cw[2])


def test_a_frame_whose_edges_weigh_nothing_is_held_and_named(make, step):
    p, _, _ = make(noise=0.02)
    weight = p.weight.clone()
    weight[(p.ii == 3) | (p.jj == 3)] = 0.0
    got = step(replace(p, weight=weight))
    assert got.report.status == "ok"
    assert got.report.isolated == (3,)
    assert torch.equal(got.T_cw[3], p.T_cw[3])


def test_a_frame_without_edges_still_follows_its_prior(make, step):
    p, _, _ = make(noise=0.02)
    keep = (p.ii != 3) & (p.jj != 3)
    p = replace(p, ii=p.ii[keep], jj=p.jj[keep], target=p.target[keep], weight=p.weight[keep])
    prior = torch.zeros_like(p.disps)
    prior[3, :2] = 0.8
    got = step(replace(p, prior=prior, prior_weight=0.2))
    torch.testing.assert_close(got.disps[3, :2], prior[3, :2])
    assert torch.equal(got.disps[3, 2:], p.disps[3, 2:])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_free_gauge_without_damping_is_singular(make, dtype, step):
    p, _, _ = make(n=2, reach=1, dtype=dtype, noise=0.02, lm=0.0, ep=0.0)
    p = replace(p, damping=torch.zeros_like(p.damping))
    for fixed in ([False, False], [True, False]):  # six and one free directions, plus scale
        q = replace(p, fixed=torch.tensor(fixed))
        got = step(q)
        assert got.report.status == "singular"
        assert_unchanged(got, q)


def test_damping_makes_a_free_gauge_solvable(make, step):
    p, _, _ = make(n=2, reach=1, noise=0.02, lm=1e-4, ep=0.1)
    got = step(replace(p, fixed=torch.zeros(2, dtype=torch.bool)))
    assert got.report.status == "ok"
    assert_finite(got)


def test_no_edges_at_all(make, step):
    p, _, _ = make()
    none = torch.zeros(0, dtype=torch.int64)
    p = replace(p, ii=none, jj=none, target=p.target[:0], weight=p.weight[:0])
    for guard in (False, True):
        got = step(replace(p, guard=guard))
        assert got.report.status == "empty"
        assert got.report.isolated == (1, 2, 3, 4)
        assert_unchanged(got, p)


def test_nothing_free_in_motion_only(make, step):
    p, _, _ = make(noise=0.02, motion_only=True, fixed=torch.ones(5, dtype=torch.bool))
    got = step(p)
    assert got.report.status == "empty"
    assert_unchanged(got, p)


def test_everything_behind_the_camera(make, step):
    p, _, _ = make()
    T_cw = p.T_cw.clone()
    T_cw[:, 2] += -40.0 * torch.arange(5)
    keep = p.ii < p.jj
    p = replace(
        p,
        T_cw=T_cw,
        ii=p.ii[keep],
        jj=p.jj[keep],
        target=p.target[keep],
        weight=p.weight[keep],
    )
    _, valid = projective.reproject(p.T_cw, p.disps, p.intrinsics, p.ii, p.jj)
    assert not valid.any()
    got = step(p)
    assert got.report.status == "empty"
    assert_unchanged(got, p)


@pytest.mark.parametrize("field", ["T_cw", "disps", "intrinsics"])
@pytest.mark.parametrize("guard", [False, True])
def test_a_state_that_is_not_finite_is_reported(make, field, guard, step):
    p, _, _ = make(noise=0.02, guard=guard)
    broken = getattr(p, field).clone()
    broken.view(-1)[-1] = NAN
    got = step(replace(p, **{field: broken}))
    assert got.report.status in ("nonfinite", "singular")
    torch.testing.assert_close(got.T_cw, broken if field == "T_cw" else p.T_cw, equal_nan=True)


def test_a_cell_whose_damping_is_not_finite_keeps_its_depth(make, step):
    p, _, _ = make(noise=0.02)
    damping = p.damping.clone()
    damping[1, 2, 3] = NAN
    got = step(replace(p, damping=damping))
    assert got.report.status == "ok"
    assert_finite(got)
    assert got.disps[1, 2, 3] == p.disps[1, 2, 3]


@pytest.mark.parametrize("guard", [False, True])
def test_values_that_overflow_single_precision(make, guard, step):
    p, _, _ = make(dtype=torch.float32, noise=0.02, guard=guard)
    target = p.target.clone()
    target[0, 0, 0] = 1e30
    got = step(replace(p, target=target))
    assert got.report.status == "ok"
    assert got.report.dropped == 1
    assert_finite(got)


def test_an_edge_from_a_frame_to_itself_is_harmless(make, step):
    p, _, _ = make(noise=0.02)
    expected = step(p)
    own = torch.tensor([2])
    got = step(
        replace(
            p,
            ii=torch.cat((p.ii, own)),
            jj=torch.cat((p.jj, own)),
            target=torch.cat((p.target, p.target[:1])),
            weight=torch.cat((p.weight, p.weight[:1])),
        )
    )
    torch.testing.assert_close(got.T_cw, expected.T_cw, atol=1e-10, rtol=0)
    torch.testing.assert_close(got.disps, expected.disps, atol=1e-10, rtol=0)
