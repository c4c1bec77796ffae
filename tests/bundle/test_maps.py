"""The kernels beside the step against what torch says: data term, distances, depth filter."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from droidw.geometry.projective import FAR_DISTANCE, frame_distance
from droidw.slam.cloud import consistent_depth
from droidw_plugins.bundle import maps
from droidw_plugins.bundle._build import BuildError
from droidw_plugins.bundle._kernel_calls import KernelLibrary
from droidw_plugins.bundle._kernel_maps import KernelMaps
from droidw_plugins.bundle._native_maps import NativeMaps
from droidw_plugins.uncertainty import _objective as objective

DTYPES = [torch.float32, torch.float64]
CLOSE = {torch.float32: {"rtol": 2e-5, "atol": 1e-5}, torch.float64: {"rtol": 1e-9, "atol": 1e-9}}


def built(make_kernels):
    try:
        return make_kernels()
    except BuildError as error:
        pytest.skip(f"the kernels cannot be compiled here: {error}")


def host_maps():
    return built(lambda: KernelMaps(KernelLibrary.for_host()))


MAPS = {"native": lambda: built(NativeMaps), "host": host_maps}


@pytest.fixture(params=MAPS)
def kernels(request):
    return MAPS[request.param]()


def sampled(make, dtype, **shape):
    """A small scene, and where its cells fall; some fall outside."""
    p, _, _ = make(dtype=dtype, noise=0.05, **shape)
    h, w = p.disps.shape[1:]
    xy, valid = objective.project(p.T_cw, p.disps, p.intrinsics, p.ii, p.jj)
    samples = objective.make_samples(xy, valid, w, p.ii, p.jj)
    assert not samples.inside.all()
    return p, samples, h * w


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [{}, {"n": 3, "h": 35, "w": 41, "reach": 1}], ids=str)
def test_pair_gradient_is_that_of_the_objective(make, kernels, dtype, shape):
    p, samples, cells = sampled(make, dtype, **shape)
    g = torch.Generator().manual_seed(4)
    u = 0.2 + 2 * torch.rand(p.disps.shape[0], cells, generator=g, dtype=torch.float64).to(dtype)
    rho = torch.rand(len(p.ii), cells, generator=g, dtype=torch.float64).to(dtype)
    rho *= samples.inside
    expected, energy = objective.pair_gradient(u, rho, samples)
    got, total = kernels.pair_gradient(u, rho, samples)
    torch.testing.assert_close(got, expected, **CLOSE[dtype])
    torch.testing.assert_close(total, energy, **CLOSE[dtype])
    again, _ = kernels.pair_gradient(u, rho, samples)
    assert torch.equal(again, got)


def test_no_pairs_have_no_gradient(make, kernels):
    p, samples, cells = sampled(make, torch.float32)
    u = torch.ones(p.disps.shape[0], cells)
    got, total = kernels.pair_gradient(u, torch.zeros(len(p.ii), cells), samples)
    assert float(total) == 0.0
    assert not got.any()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [3, 8, 21])
def test_similarity_is_that_of_the_objective(make, dtype, channels):
    p, samples, cells = sampled(make, dtype)
    g = torch.Generator().manual_seed(4)
    shape = (p.disps.shape[0], cells, channels)
    features = torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)
    features[0, 5] = 0.0
    expected = objective.similarity(features, samples)
    got = built(NativeMaps).similarity(features, samples)
    torch.testing.assert_close(got, expected, rtol=0, atol=2e-6)


def test_samples_outside_the_table_are_refused(make):
    p, samples, cells = sampled(make, torch.float32)
    few = torch.ones(p.disps.shape[0] - 1, cells)
    with pytest.raises(ValueError, match="outside the table"):
        built(NativeMaps).pair_gradient(few, torch.ones(len(p.ii), cells), samples)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("bidirectional", [False, True])
def test_frame_distance(make, kernels, dtype, bidirectional):
    p, _, _ = make(dtype=dtype, noise=0.05, h=7, w=13)
    T_cw = p.T_cw.clone()
    T_cw[4, 2] -= 3.0  # out of sight of some
    args = (T_cw, p.disps, p.intrinsics, p.ii, p.jj, 0.3, bidirectional)
    expected = frame_distance(*args)
    assert (expected > 0.4 * FAR_DISTANCE).any() and (expected < 20).any()
    torch.testing.assert_close(kernels.frame_distance(*args), expected, **CLOSE[dtype])


class Six:
    """As much of a store of six keyframes as the depth filter asks for."""

    def __init__(self, T_cw, disps, intrinsics):
        self.T_cw, self.disps, self.intrinsics, self.device = T_cw, disps, intrinsics, disps.device
        self.grid = SimpleNamespace(height=disps.shape[1], width=disps.shape[2])

    def __len__(self):
        return len(self.disps)


@pytest.mark.parametrize("dtype", DTYPES)
def test_confirmed_views_are_those_of_the_cloud(make, dtype):
    p, T_cw, disps = make(n=6, h=12, w=16, dtype=dtype)
    disps = 0.5 + 0.1 * (disps - 0.5)
    store = Six(T_cw, disps, p.intrinsics)
    views = host_maps().confirmed_views(T_cw, disps, p.intrinsics, 0.05)
    for least in (1, 3):
        expected = consistent_depth(store, 0.05, least, 1e-5)
        got = views >= least
        assert 0.05 < float(expected.float().mean()) < 0.95
        # a cell on the very threshold may go either way
        assert float((got != expected).float().mean()) <= (0.002 if dtype == torch.float32 else 0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_parameter_gradient(dtype):
    g = torch.Generator().manual_seed(1)
    rows = torch.randn(1500, 5, generator=g, dtype=torch.float64).to(dtype)
    weight = torch.randn(1500, generator=g, dtype=torch.float64).to(dtype)
    expected = torch.cat((weight @ rows, weight.sum()[None]))
    got = host_maps().parameter_gradient(weight, rows)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


def test_without_a_compiler_there_are_none(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    assert maps.map_kernels(torch.device("cpu")) is None
