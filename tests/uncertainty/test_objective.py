"""The consistency objective: published numbers, analytic gradients, the sampling adjoint."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from droidw.geometry import se3
from droidw.geometry.projective import reproject
from droidw.testing.pretend_gpu import PretendGpu
from droidw_plugins.uncertainty import _objective as objective

F64 = torch.float64


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _samples(coords: Tensor, valid: Tensor, ii: Tensor, jj: Tensor) -> objective.Samples:
    """Samples of places [E,h,w,2], in the order that one writes them down."""
    xy = coords.flatten(1, 2).transpose(1, 2)
    return objective.make_samples(xy, valid.flatten(1), coords.shape[2], ii, jj)


def _moved(samples: objective.Samples, device: str) -> objective.Samples:
    """The same on another device."""
    every = {f.name: getattr(samples, f.name) for f in fields(samples) if f.name != "steps"}
    return replace(samples, **{name: value.to(device) for name, value in every.items()})


def _corners(samples: objective.Samples) -> Tensor:
    """Rows [E*P,4] of the four neighbours."""
    return samples.first[:, None] + torch.tensor(samples.steps)


def _problem(seed: int = 0) -> tuple[Tensor, Tensor, objective.Samples]:
    """u [3,20], rho [4,20] and samples of 4 edges on a 4x5 grid; some places fall outside."""
    g = _generator(seed)
    coords = torch.rand(4, 4, 5, 2, generator=g, dtype=F64) * 6 - 1
    coords[0, 0, 0] = torch.tensor([4.0, 3.0])  # the last cell exactly
    coords[0, 0, 1] = float("nan")
    valid = torch.rand(4, 4, 5, generator=g) > 0.1
    ii, jj = torch.tensor([0, 0, 1, 2]), torch.tensor([1, 2, 0, 0])
    samples = _samples(coords, valid, ii, jj)
    u = torch.rand(3, 20, generator=g, dtype=F64) + 0.2
    rho = torch.rand(4, 20, generator=g, dtype=F64) * samples.inside
    return u, rho, samples


def test_samples_are_the_bilinear_interpolation_of_the_grid() -> None:
    _, _, samples = _problem()
    assert 10 < int(samples.inside.sum()) < 80
    y, x = torch.meshgrid(torch.arange(4.0), torch.arange(5.0), indexing="ij")
    coords = torch.rand(1, 4, 5, 2, generator=_generator(1), dtype=F64) * 3
    valid = torch.ones(1, 4, 5, dtype=torch.bool)
    found = _samples(coords, valid, torch.tensor([0]), torch.tensor([1]))
    for axis, table in enumerate((x, y)):
        stack = torch.stack([torch.full((20,), -9.0), table.flatten()]).to(F64)
        sampled = objective.interpolate(stack, found)
        assert torch.allclose(sampled, coords[..., axis].flatten(1), atol=1e-12)
    assert torch.allclose(found.weights.sum(0), torch.ones(20, dtype=F64))


def test_outside_behind_and_nan_take_no_part() -> None:
    coords = torch.tensor([[-0.01, 0], [4.01, 0], [0, 3.01], [math.nan, 1], [4, 3]], dtype=F64)
    grid = torch.zeros(1, 4, 5, 2, dtype=F64)
    grid[0, 0] = coords
    valid = torch.ones(1, 4, 5, dtype=torch.bool)
    valid[0, 3] = False
    samples = _samples(grid, valid, torch.tensor([0]), torch.tensor([0]))
    inside = samples.inside.view(4, 5)
    assert inside[0].tolist() == [False, False, False, False, True]
    assert bool(inside[1:3].all())
    assert not bool(inside[3].any())
    rho = objective.residual(torch.zeros(1, 20, dtype=F64), samples, 0.5)
    assert torch.equal(rho.view(4, 5) == 1, inside)
    assert float(rho.sum()) == float(inside.sum())


def test_scatter_is_the_adjoint_of_interpolate() -> None:
    u, _, samples = _problem()
    values = torch.randn(4, 20, generator=_generator(5), dtype=F64)
    left = (objective.interpolate(u, samples) * values).sum()
    right = (u * objective.scatter(values, samples, 3)).sum()
    assert abs(float(left - right)) < 1e-12


@pytest.mark.parametrize("decoupled", [True, False])
def test_pair_gradient_against_autograd(decoupled: bool) -> None:
    u, rho, samples = _problem()
    u.requires_grad_()
    energy = objective.pair_energy(u, rho, samples, decoupled)
    (expected,) = torch.autograd.grad(energy, u)
    gradient, value = objective.pair_gradient(u.detach(), rho, samples, decoupled)
    assert float((gradient - expected).abs().max()) < 1e-6 * float(expected.abs().max())
    assert torch.allclose(value, energy.detach(), rtol=1e-12)


def test_frame_gradient_against_autograd_of_each_frames_own_energy() -> None:
    # J of frame k is the derivative with respect to u_k of
    # gamma_data / n_k * (pair energy) + gamma_prior * sum log(u + 1).
    u, rho, samples = _problem()
    counts = torch.tensor([4, 2, 2])
    u.requires_grad_()
    pair, _ = objective.pair_gradient(u.detach(), rho, samples)
    found = objective.frame_gradient(
        pair.view(3, 4, 5), u.detach().view(3, 4, 5), counts, 0.1, 0.05
    ).view(3, 20)
    sums = objective.frame_gradient(pair.view(3, 4, 5), u.detach().view(3, 4, 5), None, 1.0, 0.05)
    total = objective.pair_energy(u, rho, samples) + 0.05 * torch.log(u + 1).sum()
    (expected,) = torch.autograd.grad(total, u)
    assert torch.allclose(sums.view(3, 20), expected, atol=1e-9)
    for k in range(3):
        energy = 0.1 / (float(counts[k]) + 1e-6) * objective.pair_energy(u, rho, samples)
        energy = energy + 0.05 * torch.log(u + 1).sum()
        (expected,) = torch.autograd.grad(energy, u)
        assert torch.allclose(found[k], expected[k], atol=1e-9)


def test_softplus_has_the_published_values_and_slope() -> None:
    y = torch.linspace(-30, 30, 121, dtype=F64, requires_grad=True)
    u = objective.softplus(y, 0.1)
    assert torch.allclose(u, torch.log(1.1 + torch.exp(y)), atol=1e-12)
    (slope,) = torch.autograd.grad(u.sum(), y)
    assert torch.allclose(slope, objective.softplus_slope(y.detach(), 0.1), atol=1e-9)
    # REFERENCE 11: u(0) and the y at which the gate starts to close
    assert abs(float(objective.softplus(torch.zeros(1, dtype=F64), 0.1)) - 0.74194) < 1e-5
    assert abs(float(objective.softplus(torch.tensor([0.11826], dtype=F64), 0.1)) - 0.8) < 1e-5
    assert abs(float(objective.softplus(torch.zeros(1, dtype=F64), 0.0)) - math.log(2)) < 1e-12
    assert bool(torch.isfinite(objective.softplus(torch.tensor([1e4, -1e4]), 0.1)).all())


@pytest.mark.parametrize(
    ("cosine", "u"),
    [(0.95, 0.54), (0.9, 0.7), (0.858, 0.8), (0.8, 0.92), (0.7, 1.08), (0.5, 1.77), (0.1, 1.77)],
)
def test_fixed_points_are_the_published_ones(cosine: float, u: float) -> None:
    # REFERENCE 4.3: with the same u on both sides of every edge, rho = 0.5 u^3 / (u + 1).
    coords = (
        torch.stack(torch.meshgrid(torch.arange(5.0), torch.arange(4.0), indexing="xy"), dim=-1)
        .to(F64)[None]
        .expand(2, -1, -1, -1)
    )
    valid = torch.ones(2, 4, 5, dtype=torch.bool)
    samples = _samples(coords, valid, torch.tensor([0, 1]), torch.tensor([1, 0]))
    rho = objective.residual(torch.full((2, 20), cosine, dtype=F64), samples, 0.5)
    table = torch.full((2, 20), 1.0, dtype=F64)
    for _ in range(3000):
        pair, _ = objective.pair_gradient(table, rho, samples)
        # gamma_data 0.1 times two derivatives of the pair energy over n_k = 2 edges
        counts = torch.tensor([2, 2])
        step = objective.frame_gradient(pair.view(2, 4, 5), table.view(2, 4, 5), counts, 0.1, 0.05)
        table = table - 0.5 * step.view(2, 20)
    assert abs(float(table.mean()) - u) < 0.006
    assert float(table.std()) < 1e-9


def test_residual_follows_clamp_and_threshold() -> None:
    coords = torch.zeros(1, 1, 5, 2)
    samples = _samples(
        coords, torch.ones(1, 1, 5, dtype=torch.bool), torch.tensor([0]), torch.tensor([0])
    )
    cosine = torch.tensor([[-0.3, 0.5, 0.51, 1.2, 0.9]])
    found = objective.residual(cosine, samples, 0.5)
    assert torch.allclose(found, torch.tensor([[1.0, 1.0, 0.49, 0.0, 0.1]]))
    # the paper's form: neither clamped from below nor cut
    plain = objective.residual(cosine, samples, -1.0, -1.0)
    assert torch.allclose(plain, torch.tensor([[1.3, 0.5, 0.49, 0.0, 0.1]]))
    clamped = objective.residual(cosine, samples, -1.0, 0.0)
    assert torch.allclose(clamped, torch.tensor([[1.0, 0.5, 0.49, 0.0, 0.1]]))


def test_similarity_is_the_cosine_with_the_interpolated_vector() -> None:
    _, _, samples = _problem(4)
    features = torch.randn(3, 20, 7, generator=_generator(6), dtype=F64)
    found = objective.similarity(features, samples)
    there = (features.view(60, 7)[_corners(samples)] * samples.weights.T[..., None]).sum(1)
    expected = torch.nn.functional.cosine_similarity(
        features[samples.source], there.view(4, 20, 7), dim=2
    )
    assert torch.allclose(found, expected, atol=1e-5)
    assert torch.allclose(objective.similarity(features * 9, samples), found, atol=1e-5)


def test_similarity_on_a_gpu_in_groups_of_edges_is_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, _, samples = _problem(4)
    features = torch.randn(3, 20, 7, generator=_generator(6), dtype=F64)
    whole = objective.similarity(features, samples)
    for together in (1, 60, 1000):  # an edge at a time, three and one, all of them
        monkeypatch.setattr(objective, "_TOGETHER", together)
        with PretendGpu():
            there = features.to("cuda")
            assert there.is_cuda
            found = objective.similarity(there, _moved(samples, "cuda"))
            torch.testing.assert_close(found.cpu(), whole, rtol=1e-9, atol=1e-9)


def test_similarity_in_parts_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, samples = _problem(4)
    features = torch.randn(3, 20, 7, generator=_generator(6))
    whole = objective.similarity(features, samples)
    monkeypatch.setattr(objective, "_CHUNK", 1)
    assert torch.equal(objective.similarity(features, samples), whole)


def test_projection_is_that_of_the_geometry() -> None:
    g = _generator(8)
    T_cw = se3.exp(torch.randn(3, 6, generator=g, dtype=F64) * 0.2)
    disps = torch.rand(3, 4, 5, generator=g, dtype=F64) * 2
    intrinsics = torch.tensor([4.0, 5.0, 2.1, 1.4], dtype=F64)
    ii, jj = torch.tensor([0, 2, 1]), torch.tensor([1, 0, 2])
    coords, valid = reproject(T_cw, disps, intrinsics, ii, jj)
    xy, near = objective.project(T_cw, disps, intrinsics, ii, jj)
    assert torch.equal(near.view(3, 4, 5), valid)
    assert torch.allclose(xy.view(3, 2, 4, 5), coords.movedim(-1, 1), atol=1e-12)


def test_samples_of_some_edges() -> None:
    u, _, samples = _problem()
    whole = objective.interpolate(u, samples)
    chosen = torch.tensor([True, False, True, True])
    assert torch.equal(objective.interpolate(u, samples.of(chosen)), whole[chosen])
    some = samples.of(torch.tensor([2]))
    assert torch.equal(some.inside, samples.inside[2:3])
    assert torch.equal(some.place, samples.place[2:3])


def test_edges_between_neighbours_do_not_count() -> None:
    ii, jj = torch.tensor([0, 1, 3, 5]), torch.tensor([1, 3, 3, 2])
    assert objective.edges_used(ii, jj, 2).tolist() == [False, True, False, True]
    assert objective.edges_used(ii, jj, 1).tolist() == [True, True, False, True]
