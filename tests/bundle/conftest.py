"""A small synthetic bundle adjustment problem with exact flow."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.geometry import projective, se3
from droidw.solve.problem import BAProblem


def with_cross(weight, seed=0):
    """Information (xx, yy, xy) of these weights: some of rank 1, some of x or y alone."""
    g = torch.Generator().manual_seed(seed)
    shape = weight.shape[:-1]

    def some(share):
        return torch.rand(shape, generator=g) < share

    alone = torch.stack((some(0.1), some(0.1)), dim=-1)
    weight = torch.where(alone, torch.zeros_like(weight), weight)
    tilt = 2 * torch.rand(shape, generator=g, dtype=torch.float64).to(weight.dtype) - 1
    tilt = torch.where(some(0.2), tilt.sign(), tilt)
    cross = tilt * weight.prod(-1).sqrt()
    return torch.cat((weight, cross[..., None]), dim=-1)


def make_problem(
    n=5, h=6, w=8, reach=2, dtype=torch.float64, noise=0.0, seed=0, cross=False, **changes
):
    """n cameras on a curve over a wavy surface; `noise` perturbs the start, not the flow."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)

    s = torch.linspace(0, 1, n, dtype=torch.float64)
    path = (0.6 * s, 0.1 * (4 * s).sin(), 0.2 * s, 0.05 * (3 * s).sin(), 0.1 * s, 0.03 * s)
    T_cw = se3.exp(torch.stack(path, dim=1)).to(dtype)
    K = torch.tensor([0.9 * w, 0.95 * w, w / 2 - 0.4, h / 2 - 0.6], dtype=dtype)
    x, y = projective.pixel_grid(h, w, dtype).unbind(-1)
    k = torch.arange(n, dtype=dtype)[:, None, None]
    disps = 0.5 + 0.2 * (0.5 * x + k).sin() + 0.15 * (0.7 * y + 0.3 * k).cos()
    edges = [(i, j) for i in range(n) for j in range(n) if i != j and abs(i - j) <= reach]
    ii, jj = torch.tensor(edges).T.contiguous()
    target, _ = projective.reproject(T_cw, disps, K, ii, jj)
    weight = 0.1 + torch.rand(target.shape, generator=g, dtype=torch.float64).to(dtype)
    fixed = torch.zeros(n, dtype=torch.bool)
    fixed[0] = True
    xi = noise * draw(n, 6)
    xi[0] = 0
    problem = BAProblem(
        T_cw=se3.retract(T_cw, xi),
        disps=disps * (1 + 4 * noise * draw(*disps.shape)).clamp(0.2, 3.0),
        intrinsics=K,
        ii=ii,
        jj=jj,
        target=target,
        weight=with_cross(weight, seed) if cross else weight,
        fixed=fixed,
        damping=torch.full_like(disps, 1e-6),
    )
    return replace(problem, **changes), T_cw, disps


@pytest.fixture
def make():
    return make_problem


def _cast(problem, dtype, device="cpu"):
    moved = {
        name: value.to(device, dtype if value.is_floating_point() else value.dtype)
        for name, value in vars(problem).items()
        if isinstance(value, torch.Tensor)
    }
    return replace(problem, **moved)


@pytest.fixture
def cast():
    """A problem with another type of floating-point numbers, on a device."""
    return _cast


def torch_backend(**options):
    from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster, TorchBundleOptions

    return TorchBundleAdjuster(TorchBundleOptions(**options))


def native_backend(**options):
    from droidw_plugins.bundle.native_ba import COMPONENT, NativeBundleAdjuster, NativeBundleOptions

    reason = COMPONENT.available()
    if reason:
        pytest.skip(f"backend native cannot run here: {reason}")
    return NativeBundleAdjuster(NativeBundleOptions(**options))


def host_backend(**options):
    """The kernels of backend cuda, their threads run in a loop on the CPU."""
    from droidw_plugins.bundle._build import BuildError
    from droidw_plugins.bundle._kernel_calls import KernelLibrary
    from droidw_plugins.bundle._kernel_step import KernelStepper

    try:
        return KernelStepper(KernelLibrary.for_host(), **options)
    except BuildError as error:
        pytest.skip(f"the kernels cannot be compiled here: {error}")


def cuda_backend(**options):
    from droidw_plugins.bundle.cuda_ba import CudaBundleAdjuster, CudaBundleOptions

    return CudaBundleAdjuster(CudaBundleOptions(**options))


BACKENDS = {"torch": torch_backend, "native": native_backend, "host": host_backend}


@pytest.fixture
def backends():
    """Name -> what makes an adjuster, on a GPU too."""
    return {**BACKENDS, "cuda": cuda_backend}


@pytest.fixture(params=BACKENDS)
def backend(request):
    """Makes an adjuster of every backend that can run here; options by name."""
    return BACKENDS[request.param]


@pytest.fixture
def step(backend):
    """One step of every backend, from a fresh adjuster."""
    return lambda problem, **options: backend(**options).step(problem)


@pytest.fixture
def descend(backend):
    """Steps until one is not "ok": the problem where they end, and their reports."""

    def run(problem, steps):
        adjuster, reports = backend(), []
        for _ in range(steps):
            result = adjuster.step(problem)
            reports.append(result.report)
            problem = replace(problem, T_cw=result.T_cw, disps=result.disps)
            if result.report.status != "ok":
                break
        return problem, reports

    return run
