"""Every backend against dense normal equations, and its promises about every step."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.geometry import projective, se3
from droidw.solve.problem import PoseTerm


def matrices(weight):
    """Information [...,2,2] of weights with two or three channels."""
    xx, yy = weight[..., 0], weight[..., 1]
    xy = weight[..., 2] if weight.shape[-1] == 3 else torch.zeros_like(xx)
    return torch.stack((xx, xy, xy, yy), dim=-1).unflatten(-1, (2, 2))


def squared(weight, r):
    """r^T W r, [...,1]."""
    return torch.einsum("...a,...ab,...b->...", r, matrices(weight), r)[..., None]


def robust_length(weight, r):
    mean = weight[..., :2].mean(-1, keepdim=True)
    # a cell without any weight has no length, and one of rank 1 a square of -0 by rounding
    return (squared(weight, r).clamp_min(1e-300) / mean.clamp_min(1e-300)).sqrt()


def dense_band(band):
    """The matrix [6N,6N] of a term of the poses."""
    n = len(band)
    H = torch.zeros(n, 6, n, 6, dtype=torch.float64)
    for k in range(n):
        for m in range(min(band.shape[1], k + 1)):
            H[k, :, k - m] = band[k, m]
            H[k - m, :, k] = band[k, m].T
    return H.view(6 * n, 6 * n)


def pose_term_of(n, reach, seed=0):
    """Some term whose matrix is J^T J; blocks of poses that do not exist are NaN."""
    g = torch.Generator().manual_seed(seed)
    J = torch.randn(n, reach + 1, 5, 6, generator=g, dtype=torch.float64)
    H = torch.zeros(n + reach, 6, n + reach, 6, dtype=torch.float64)
    for k in range(n):
        row = torch.zeros(5, n + reach, 6, dtype=torch.float64)
        row[:, k : k + reach + 1] = J[k].transpose(0, 1)
        H += torch.einsum("rak,rbl->akbl", row, row)
    H = H[:n, :, :n]
    band = torch.full((n, reach + 1, 6, 6), torch.nan, dtype=torch.float64)
    for k in range(n):
        for m in range(min(reach, k) + 1):
            band[k, m] = H[k, :, k - m]
    return PoseTerm(band, torch.randn(n, 6, generator=g, dtype=torch.float64))


def dense_step(p):
    """The same step by the full normal equations over all poses and depths."""
    n, h, w = p.disps.shape
    cells, n_pose = h * w, 6 * n
    J_i, J_j, J_z = projective.jacobians(p.T_cw, p.disps, p.intrinsics, p.ii, p.jj)
    coords, valid = projective.reproject(p.T_cw, p.disps, p.intrinsics, p.ii, p.jj)
    residual = p.target - coords
    weight = p.weight * valid[..., None]
    if p.huber is not None:
        length = robust_length(weight, residual)
        weight = weight * (p.huber / length.clamp_min(p.huber))
    size = n_pose + n * cells
    H, g = torch.zeros(size, size, dtype=torch.float64), torch.zeros(size, dtype=torch.float64)
    for e in range(len(p.ii)):
        i, j = int(p.ii[e]), int(p.jj[e])
        J = torch.zeros(2 * cells, size, dtype=torch.float64)
        J[:, 6 * i : 6 * i + 6] += J_i[e].reshape(-1, 6)
        J[:, 6 * j : 6 * j + 6] += J_j[e].reshape(-1, 6)
        for c in range(cells):
            J[2 * c : 2 * c + 2, n_pose + i * cells + c] = J_z[e].view(-1, 2)[c]
        J = J.view(cells, 2, size)
        WJ = matrices(weight[e]).view(cells, 2, 2) @ J
        H += torch.einsum("kas,kat->st", J, WJ)
        g += torch.einsum("kas,ka->s", WJ, residual[e].view(cells, 2))
    d, diagonal = p.disps.flatten(), p.damping.flatten()
    moves = ~p.fixed
    moves[p.ii] = True
    if p.prior is not None:
        known = (p.prior > 0).flatten()
        diagonal = torch.where(known, torch.full_like(d, p.prior_weight), diagonal)
        g[n_pose:] -= torch.where(known, p.prior_weight * (d - p.prior.flatten()), 0 * d)
    H[n_pose:, n_pose:] += torch.diag(diagonal)
    if p.pose_term is not None:
        H[:n_pose, :n_pose] += dense_band(p.pose_term.band)
        g[:n_pose] += p.pose_term.rhs.view(-1)
    free = torch.nonzero((~p.fixed)[:, None].expand(n, 6).flatten()).flatten()
    deep = n_pose + torch.nonzero(moves[:, None].expand(n, cells).flatten()).flatten()
    A, b = H[free][:, free], g[free]
    if not p.motion_only:
        solve = torch.linalg.solve(H[deep][:, deep], H[deep][:, free])
        A = A - H[free][:, deep] @ solve
        b = b - solve.T @ g[deep]
    A = A + torch.diag(p.lm * A.diagonal() + p.ep)
    dx = torch.zeros(n_pose, dtype=torch.float64)
    dx[free] = torch.linalg.solve(A, b)
    disps = p.disps.clone()
    if not p.motion_only:
        right = g[deep] - H[deep][:, free] @ dx[free]
        disps.view(-1)[deep - n_pose] += torch.linalg.solve(H[deep][:, deep], right)
        disps.clamp_(p.min_disp, p.max_disp)
    return se3.retract(p.T_cw, dx.view(n, 6)), disps, dx.view(n, 6)


def prior_of(disps):
    prior = 1.1 * disps + 0.05
    prior[:, ::2, 1::3] = 0.0
    return prior


CASES = {
    "plain": {},
    "damped": {"lm": 0.03, "ep": 0.2},
    "motion-only": {"motion_only": True},
    "two fixed": {"fixed": torch.tensor([True, False, True, False, False])},
    "last fixed": {"fixed": torch.tensor([False, False, False, False, True])},
    "all fixed": {"fixed": torch.ones(5, dtype=torch.bool)},
    "none fixed": {"fixed": torch.zeros(5, dtype=torch.bool), "lm": 1e-3},
    "huber": {"huber": 0.3},
    "cross": {"cross": True},
    "cross, huber": {"cross": True, "huber": 0.3},
    "cross, motion-only": {"cross": True, "motion_only": True},
    "bounds": {"min_disp": 0.3, "max_disp": 0.7},
    "no edge from 2": {"leave_out_source": 2},
    "fixed without edges from": {
        "leave_out_source": 2,
        "fixed": torch.tensor([True, False, True, False, False]),
    },
}


@pytest.mark.parametrize("with_prior", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_schur_solution_is_the_dense_one(make, case, with_prior, step):
    changes = dict(CASES[case])
    left_out = changes.pop("leave_out_source", None)
    p, _, _ = make(noise=0.02, **changes)
    damping = 1e-3 + 1e-2 * torch.rand(p.disps.shape, dtype=torch.float64)
    p = replace(p, damping=damping)
    if left_out is not None:
        keep = p.ii != left_out
        p = replace(p, ii=p.ii[keep], jj=p.jj[keep], target=p.target[keep], weight=p.weight[keep])
    if with_prior:
        p = replace(p, prior=prior_of(p.disps), prior_weight=0.4)
    T_cw, disps, dx = dense_step(p)
    got = step(p)
    assert got.report.status == "ok"
    torch.testing.assert_close(got.T_cw, T_cw, atol=1e-8, rtol=0)
    torch.testing.assert_close(got.disps, disps, atol=1e-8, rtol=0)
    assert got.report.step_norm == pytest.approx(float(dx.norm(dim=1).max()), abs=1e-8)
    assert torch.equal(got.T_cw[p.fixed], p.T_cw[p.fixed])


@pytest.mark.parametrize("reach", [0, 2, 4, 6])
@pytest.mark.parametrize("case", CASES)
def test_a_term_of_the_poses_is_part_of_the_system(make, case, reach, step):
    changes = dict(CASES[case])
    left_out = changes.pop("leave_out_source", None)
    p, _, _ = make(noise=0.02, **changes)
    p = replace(p, pose_term=pose_term_of(5, reach), damping=torch.full_like(p.disps, 1e-2))
    if left_out is not None:
        keep = p.ii != left_out
        p = replace(p, ii=p.ii[keep], jj=p.jj[keep], target=p.target[keep], weight=p.weight[keep])
    T_cw, disps, _ = dense_step(p)
    got = step(p)
    assert got.report.status == "ok"
    torch.testing.assert_close(got.T_cw, T_cw, atol=1e-8, rtol=0)
    torch.testing.assert_close(got.disps, disps, atol=1e-8, rtol=0)


def test_a_term_of_the_poses_is_no_measurement(make, step):
    p, _, _ = make(noise=0.02)
    keep = (p.ii != 4) & (p.jj != 4)
    p = replace(p, ii=p.ii[keep], jj=p.jj[keep], target=p.target[keep], weight=p.weight[keep])
    got = step(replace(p, pose_term=pose_term_of(5, 2)))
    assert got.report.isolated == (4,)
    assert torch.equal(got.T_cw[4], p.T_cw[4])
    assert not torch.equal(got.T_cw[3], step(p).T_cw[3])


def test_a_guarded_step_counts_the_term_of_the_poses(make, step):
    p, _, _ = make(noise=0.02, guard=True)
    term = pose_term_of(5, 2)
    before, (T_cw, disps, dx) = step(p).report.cost_before, dense_step(replace(p, pose_term=term))
    report = step(replace(p, pose_term=term)).report
    x = dx.view(-1)
    known = float(x @ dense_band(term.band) @ x - 2 * term.rhs.view(-1) @ x)
    coords, valid = projective.reproject(T_cw, disps, p.intrinsics, p.ii, p.jj)
    rest = float((squared(p.weight, p.target - coords) * valid[..., None]).sum())
    assert report.cost_before == pytest.approx(before, rel=1e-12)
    assert report.cost_after == pytest.approx(rest + known, rel=1e-9)
    # a term that calls every step of the measurements bad
    against = replace(term, band=1e9 * torch.eye(6, dtype=torch.float64).expand(5, 1, 6, 6))
    assert step(replace(p, pose_term=replace(against, rhs=0 * term.rhs))).report.step_norm < 1e-6


@pytest.mark.parametrize("name", ["band", "rhs"])
def test_a_term_of_other_poses_is_refused(make, step, name):
    p, _, _ = make()
    term = pose_term_of(5, 2)
    with pytest.raises(ValueError, match=f"pose_term.{name}"):
        step(replace(p, pose_term=replace(term, **{name: getattr(term, name)[1:]})))


def test_near_cells_do_not_count(make, step):
    p, _, _ = make(noise=0.01)
    disps = p.disps.clone()
    T_cw = p.T_cw.clone()
    T_cw[2, 2] -= 1.2  # camera 2 moves among the points: some cells fail the near test
    p = replace(p, T_cw=T_cw, disps=disps, ep=1.0)
    _, valid = projective.reproject(T_cw, disps, p.intrinsics, p.ii, p.jj)
    assert 0 < int((~valid).sum()) < valid.numel() // 2
    expected_T, expected_disps, _ = dense_step(p)
    got = step(p)
    torch.testing.assert_close(got.T_cw, expected_T, atol=1e-8, rtol=0)
    torch.testing.assert_close(got.disps, expected_disps, atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize("cross", [False, True])
def test_energy_is_what_the_problem_defines(make, step, cross):
    p, _, _ = make(noise=0.02, cross=cross)
    p = replace(p, prior=prior_of(p.disps), prior_weight=0.4)
    coords, _ = projective.reproject(p.T_cw, p.disps, p.intrinsics, p.ii, p.jj)
    r = p.target - coords
    prior = 0.4 * ((p.disps - p.prior)[p.prior > 0] ** 2).sum()
    expected = float(squared(p.weight, r).sum() + prior)
    assert step(p).report.cost_before == pytest.approx(expected, rel=1e-12)
    assert step(replace(p, guard=True)).report.cost_before == pytest.approx(expected, rel=1e-12)
    length = robust_length(p.weight, r)
    rho = torch.where(length <= 0.2, length**2, 0.4 * length - 0.04) / length**2
    expected = float((squared(p.weight, r) * rho).sum() + prior)
    assert step(replace(p, huber=0.2)).report.cost_before == pytest.approx(expected, rel=1e-12)


def test_robust_length_is_the_plain_one_for_equal_weights(make, step):
    p, _, _ = make(noise=0.02, huber=0.2)
    weight = p.weight.mean(-1, keepdim=True).expand_as(p.weight)
    coords, _ = projective.reproject(p.T_cw, p.disps, p.intrinsics, p.ii, p.jj)
    length = (p.target - coords).norm(dim=-1)
    rho = torch.where(length <= 0.2, length**2, 0.4 * length - 0.04)
    expected = float((weight[..., 0] * rho).sum())
    assert step(replace(p, weight=weight)).report.cost_before == pytest.approx(expected, rel=1e-12)


def test_depths_stay_and_priors_are_left_alone_in_motion_only(make, step):
    p, _, _ = make(noise=0.02, motion_only=True, min_disp=0.4)
    got = step(replace(p, prior=prior_of(p.disps), prior_weight=1.0))
    assert torch.equal(got.disps, p.disps)
    assert got.disps.data_ptr() != p.disps.data_ptr()


def test_the_input_is_not_written_to(make, step):
    p, _, _ = make(noise=0.02, guard=True)
    before = [t.clone() for t in (p.T_cw, p.disps, p.target, p.weight, p.fixed, p.damping)]
    got = step(p)
    after = (p.T_cw, p.disps, p.target, p.weight, p.fixed, p.damping)
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert got.T_cw.data_ptr() != p.T_cw.data_ptr()


def shuffled(p, seed):
    order = torch.randperm(len(p.ii), generator=torch.Generator().manual_seed(seed))
    return replace(
        p, ii=p.ii[order], jj=p.jj[order], target=p.target[order], weight=p.weight[order]
    )


@pytest.mark.parametrize("cross", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_order_of_the_edges_changes_nothing(make, dtype, step, cross):
    p, _, _ = make(noise=0.02, dtype=dtype, cross=cross)
    expected = step(p)
    for seed in range(3):
        got = step(shuffled(p, seed))
        assert torch.equal(got.T_cw, expected.T_cw)
        assert torch.equal(got.disps, expected.disps)


def test_an_edge_given_twice_counts_twice(make, step):
    p, _, _ = make(noise=0.02)
    twice = replace(
        p,
        ii=torch.cat((p.ii, p.ii[:3])),
        jj=torch.cat((p.jj, p.jj[:3])),
        target=torch.cat((p.target, p.target[:3] + 0.1)),
        weight=torch.cat((p.weight, p.weight[:3])),
    )
    T_cw, disps, _ = dense_step(twice)
    for seed in range(3):
        got = step(shuffled(twice, seed))
        torch.testing.assert_close(got.T_cw, T_cw, atol=1e-9, rtol=0)
        torch.testing.assert_close(got.disps, disps, atol=1e-9, rtol=0)


def test_same_input_same_bytes_also_from_used_scratch_space(make, step, backend):
    p, _, _ = make(noise=0.02, dtype=torch.float32)
    other, _, _ = make(n=7, h=9, w=7, noise=0.05, dtype=torch.float32, guard=True)
    adjuster = backend()
    first = adjuster.step(p)
    adjuster.step(other)
    again = adjuster.step(p)
    fresh = step(p)
    for got in (again, fresh):
        assert torch.equal(got.T_cw, first.T_cw)
        assert torch.equal(got.disps, first.disps)
        assert got.report == fresh.report


def test_chunks_change_nothing_that_matters(make):
    from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster, TorchBundleOptions

    p, _, _ = make(noise=0.02, guard=True)
    whole = TorchBundleAdjuster().step(p)
    parts = TorchBundleAdjuster(TorchBundleOptions(chunk_cells=100)).step(p)
    torch.testing.assert_close(parts.T_cw, whole.T_cw, atol=1e-12, rtol=0)
    torch.testing.assert_close(parts.disps, whole.disps, atol=1e-11, rtol=0)


def test_single_precision_is_close_to_double(make, step):
    p, _, _ = make(noise=0.02)
    exact = step(p)
    single = {
        name: value.float()
        for name, value in vars(p).items()
        if isinstance(value, torch.Tensor) and value.is_floating_point()
    }
    got = step(replace(p, **single))
    assert got.T_cw.dtype == torch.float32
    torch.testing.assert_close(got.T_cw.double(), exact.T_cw, atol=2e-4, rtol=0)
    torch.testing.assert_close(got.disps.double(), exact.disps, atol=2e-3, rtol=0)


def test_component_is_light_and_builds():
    from droidw.interfaces.bundle import BundleAdjuster
    from droidw.plugin.component import BuildContext
    from droidw_plugins.bundle.torch_ba import COMPONENT

    assert COMPONENT.name == "torch"
    built = COMPONENT.factory(COMPONENT.options(), BuildContext(device=torch.device("cpu")))
    assert isinstance(built, BundleAdjuster)
