"""The compiled parts of the objective give what the torch code gives."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from droidw.geometry import se3
from droidw.interfaces.uncertainty import UncertaintyView
from droidw.plugin.component import BuildContext
from droidw_plugins.bundle._build import BuildError
from droidw_plugins.bundle._native_calls import native_recipe
from droidw_plugins.uncertainty import _native, affine_softplus
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty._native import Kernels, load_kernels

compiled = pytest.mark.skipif(native_recipe() is None, reason="no C++ compiler on this machine")


@pytest.fixture(scope="module")
def kernels() -> Kernels:
    return Kernels()


def _window(channels: int, h: int = 6, w: int = 7) -> tuple[Tensor, ...]:
    g = torch.Generator().manual_seed(channels)
    T_cw = se3.exp(torch.randn(5, 6, generator=g) * 0.15)
    disps = torch.rand(5, h, w, generator=g) * 2
    intrinsics = torch.tensor([6.0, 6.5, 3.1, 2.4])
    ii, jj = torch.tensor([1, 1, 4, 3, 2]), torch.tensor([2, 4, 1, 4, 4])
    rows = torch.randn(4, h * w, channels, generator=g)
    return T_cw, disps, intrinsics, ii, jj, rows


@compiled
@pytest.mark.parametrize(("channels", "shape"), [(64, (6, 7)), (19, (6, 7)), (3, (2, 9))])
def test_kernels_agree_with_torch(kernels: Kernels, channels: int, shape: tuple[int, int]) -> None:
    T_cw, disps, intrinsics, ii, jj, rows = _window(channels, *shape)
    xy, valid = objective.project(T_cw, disps, intrinsics, ii, jj)
    expected = objective.make_samples(xy, valid, shape[1], ii - 1, jj - 1)
    found = kernels.samples(T_cw, disps, intrinsics, ii, jj, 1)
    assert torch.equal(found.inside, expected.inside)
    assert 5 < int(found.inside.sum()) < found.inside.numel()
    assert found.steps == expected.steps
    inside = expected.inside
    where = inside[:, None].expand_as(expected.place)
    assert torch.allclose(found.place[where], expected.place[where], atol=1e-4)
    table = torch.rand(4, shape[0] * shape[1], generator=torch.Generator().manual_seed(1)) + 0.2
    assert torch.allclose(
        objective.interpolate(table, found)[inside],
        objective.interpolate(table, expected)[inside],
        atol=1e-4,
    )
    cosine = kernels.similarity(rows, found, rows.norm(dim=2))
    reference = objective.similarity(rows, found)
    assert torch.allclose(cosine[inside], reference[inside], atol=1e-5)
    assert float(cosine[~inside].abs().max()) == 0.0
    rho = objective.residual(reference, found)
    gradient, energy = kernels.pair_gradient(table, rho, found)
    g, e = objective.pair_gradient(table, rho, found)
    assert torch.allclose(gradient, g, rtol=1e-4, atol=1e-4)
    assert float(energy) == pytest.approx(float(e), rel=1e-5)


@compiled
def test_broken_poses_fall_outside(kernels: Kernels) -> None:
    T_cw, disps, intrinsics, ii, jj, _ = _window(8)
    T_cw[4] = float("nan")
    disps[3] = float("inf")
    found = kernels.samples(T_cw, disps, intrinsics, ii, jj, 1)
    assert not bool(found.inside[(ii == 4) | (jj == 4) | (ii == 3)].any())
    assert bool(torch.isfinite(found.place).all())
    last = found.first + found.steps[3]
    assert int(found.first.min()) >= 0
    assert int(last.max()) < 4 * 42


@compiled
def test_threads_do_not_change_a_bit(kernels: Kernels) -> None:
    T_cw, disps, intrinsics, ii, jj, rows = _window(64)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            samples = kernels.samples(T_cw, disps, intrinsics, ii, jj, 1)
            results.append((samples.weights, kernels.similarity(rows, samples, rows.norm(dim=2))))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_native, "native_recipe", lambda: None)


def test_without_a_compiler_torch_does_it(
    no_compiler: None, started: Callable[..., UncertaintyView]
) -> None:
    assert load_kernels() is None
    with pytest.raises(BuildError, match="no C\\+\\+ compiler"):
        Kernels()
    component = affine_softplus.COMPONENT
    context = BuildContext(torch.device("cpu"))
    maps = []
    for kernels in ("auto", "torch"):
        model = component.factory(component.options(kernels=kernels), context)
        view = started(model)
        model.update(view)
        maps.append(view.uncertainty)
    assert torch.equal(maps[0], maps[1])


@compiled
def test_models_learn_the_same_either_way(started: Callable[..., UncertaintyView]) -> None:
    component = affine_softplus.COMPONENT
    context = BuildContext(torch.device("cpu"))
    maps = []
    for kernels in ("auto", "torch"):
        model = component.factory(component.options(kernels=kernels), context)
        view = started(model)
        for _ in range(20):
            model.update(view)
        maps.append(view.uncertainty)
    assert torch.allclose(maps[0], maps[1], atol=1e-5)


def test_the_source_is_part_of_the_package() -> None:
    assert Path(_native.__file__).with_name("csrc").joinpath("consistency.cpp").is_file()
