"""Many steps on exact synthetic flow: the truth up to what is free, and never a rising cost."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.geometry import se3
from droidw.geometry.align import umeyama


def centres(T_cw):
    return se3.inv(T_cw)[:, :3].double().numpy()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("seed", [0, 1])
def test_eight_keyframes_converge_to_the_truth(make, dtype, seed, descend):
    start, T_cw, disps = make(
        n=8, h=12, w=16, reach=3, dtype=dtype, noise=0.03, seed=seed, lm=1e-5, ep=1e-3, guard=True
    )
    truth = centres(T_cw)
    path = float(torch.tensor(truth).diff(dim=0).norm(dim=1).sum())
    begin = umeyama(centres(start.T_cw), truth).apply(centres(start.T_cw))
    assert float(((begin - truth) ** 2).sum(1).mean() ** 0.5) > 0.01 * path  # really perturbed
    end, reports = descend(start, 12)
    assert all(r.status in ("ok", "rejected") for r in reports)
    found = umeyama(centres(end.T_cw), truth)
    error = found.apply(centres(end.T_cw)) - truth
    assert float((error**2).sum(1).mean() ** 0.5) < 1e-4 * path
    relative = end.disps / found.scale / disps - 1
    assert float(relative.abs().max()) < (1e-6 if dtype == torch.float64 else 1e-2)
    assert float(relative.abs().median()) < (1e-7 if dtype == torch.float64 else 1e-4)


def test_the_prior_gives_the_scale(make, descend):
    start, T_cw, disps = make(n=6, h=8, w=10, noise=0.02)
    start = replace(start, prior=disps, prior_weight=0.5, lm=1e-5, ep=1e-4)
    end, _ = descend(start, 25)
    torch.testing.assert_close(end.T_cw, T_cw, atol=1e-6, rtol=0)
    torch.testing.assert_close(end.disps, disps, atol=1e-6, rtol=0)


def test_motion_only_finds_the_poses_for_given_depths(make, descend):
    start, T_cw, disps = make(n=6, h=8, w=10, noise=0.03, motion_only=True)
    end, _ = descend(replace(start, disps=disps, ep=1e-3), 10)
    torch.testing.assert_close(end.T_cw, T_cw, atol=1e-9, rtol=0)


@pytest.mark.parametrize("huber", [None, 0.5])
@pytest.mark.parametrize("noise", [0.02, 0.08, 0.2])
@pytest.mark.parametrize("prior_weight", [0.0, 0.05])
def test_the_guard_never_lets_the_cost_rise(make, huber, noise, prior_weight, descend):
    p, _, disps = make(n=6, h=8, w=10, noise=noise, lm=0.0, ep=1e-6, guard=True, huber=huber)
    g = torch.Generator().manual_seed(5)
    wild = torch.rand(p.target.shape[:3], generator=g) < 0.15
    target = p.target.clone()
    target[wild] += 6 * torch.randn(int(wild.sum()), 2, generator=g, dtype=torch.float64)
    p = replace(p, target=target, prior=disps, prior_weight=prior_weight)
    _, reports = descend(p, 15)
    assert reports[0].status == "ok"
    assert reports[-1].cost_before < 0.9 * reports[0].cost_before
    for r in reports:
        assert r.status in ("ok", "rejected")
        if r.status == "ok":
            assert r.cost_after <= r.cost_before


def test_huber_resists_outliers(make, descend):
    p, T_cw, _ = make(n=6, h=8, w=10, noise=0.02, guard=True, ep=1e-3)
    g = torch.Generator().manual_seed(8)
    wild = torch.rand(p.target.shape[:3], generator=g) < 0.1
    target = p.target.clone()
    target[wild] += 5 * torch.randn(int(wild.sum()), 2, generator=g, dtype=torch.float64)
    p = replace(p, target=target)
    truth = centres(T_cw)

    def error(end):
        moved = umeyama(centres(end.T_cw), truth).apply(centres(end.T_cw))
        return float(((moved - truth) ** 2).sum(1).mean() ** 0.5)

    plain, _ = descend(p, 20)
    robust, _ = descend(replace(p, huber=0.05), 20)
    assert error(robust) < 0.1 * error(plain)


def test_guard_shortens_a_step_that_would_overshoot(make, step):
    p, _, _ = make(n=5, h=6, w=8, noise=0.5, lm=0.0, ep=1e-9, seed=0)
    free_run = step(p)
    guarded = step(replace(p, guard=True))
    assert guarded.report.status == "ok"
    assert guarded.report.cost_after < guarded.report.cost_before
    assert guarded.report.step_norm == pytest.approx(0.5 * free_run.report.step_norm)
    never = step(replace(p, guard=True), halvings=0)
    assert never.report.status == "rejected"
    assert torch.equal(never.T_cw, p.T_cw)
    assert torch.equal(never.disps, p.disps)


def test_a_finished_problem_is_left_at_rest(make, descend):
    p, T_cw, disps = make(guard=True)
    end, reports = descend(p, 3)
    assert all(r.status in ("ok", "rejected") for r in reports)
    torch.testing.assert_close(end.T_cw, T_cw, atol=1e-10, rtol=0)
    torch.testing.assert_close(end.disps, disps, atol=1e-10, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_gauge_freedom(make, seed, step):
    """A similarity of the world changes no residual, so the cost is the same and steps agree."""
    p, _, _ = make(noise=0.02, seed=seed, lm=1e-3, ep=0.0)
    p = replace(p, damping=torch.zeros_like(p.damping))
    g = torch.Generator().manual_seed(seed)
    world = se3.exp(torch.randn(6, generator=g, dtype=torch.float64))
    moved = replace(p, T_cw=se3.mul(p.T_cw, world))
    a, b = step(p), step(moved)
    assert b.report.cost_before == pytest.approx(a.report.cost_before, rel=1e-9)
    torch.testing.assert_close(
        se3.matrix(b.T_cw), se3.matrix(se3.mul(a.T_cw, world)), atol=1e-8, rtol=0
    )
    torch.testing.assert_close(b.disps, a.disps, atol=1e-8, rtol=0)

    scale = 3.0
    larger = p.T_cw.clone()
    larger[:, :3] *= scale
    c = step(replace(p, T_cw=larger, disps=p.disps / scale, min_disp=1e-9))
    assert c.report.cost_before == pytest.approx(a.report.cost_before, rel=1e-9)
    torch.testing.assert_close(c.disps * scale, a.disps, atol=1e-7, rtol=0)
    # the step of the translation scales with the world; exp mixes it with the turn by V(phi)
    torch.testing.assert_close(c.T_cw[:, :3] / scale, a.T_cw[:, :3], atol=1e-7, rtol=0)
    torch.testing.assert_close(c.T_cw[:, 3:], a.T_cw[:, 3:], atol=1e-7, rtol=0)
