"""Every backend on random problems against torch in float64, one step and many.

In float32 a step may differ by 1e-4 of its size; one that converges, by 2 % in its error. What the
kernels of backend cuda compute is run on a CPU as `host`; `cuda` itself needs a GPU.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.geometry import se3
from droidw.geometry.align import umeyama
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster


@pytest.fixture(params=["torch", "native", "host", pytest.param("cuda", marks=pytest.mark.gpu)])
def tested(request, backends):
    return request.param, backends[request.param]


def random_problem(make, seed):
    """Sizes, edges, fixed and empty frames, priors, kernels and broken cells by chance.

    Every second one has cross terms.
    """
    g = torch.Generator().manual_seed(seed)

    def pick(*choices):
        return choices[int(torch.randint(len(choices), (1,), generator=g))]

    n = pick(2, 3, 6, 11)
    h, w = pick((3, 5), (8, 11), (24, 32), (33, 40))
    p, _, _ = make(
        n=n, h=h, w=w, reach=pick(1, 2, 4), noise=pick(0.005, 0.02), seed=seed,
        lm=1e-2, ep=1.0, huber=pick(None, 0.3), motion_only=pick(False, False, True),
        guard=pick(False, True), max_disp=pick(None, 2.0), cross=seed % 2 == 1,
    )  # fmt: skip
    # some edges go, some come twice, some lead nowhere
    some = torch.rand(len(p.ii), generator=g) < pick(0.5, 1.0)
    some[0] = True
    index = torch.cat((torch.nonzero(some).flatten(), torch.randint(len(some), (2,), generator=g)))
    p = replace(p, ii=p.ii[index], jj=p.jj[index], target=p.target[index], weight=p.weight[index])
    fixed = torch.rand(n, generator=g) < 0.3
    fixed[int(torch.randint(n, (1,), generator=g))] = True
    weight = p.weight.clone()
    weight[torch.rand(weight.shape[:3], generator=g) < 0.2] = 0.0
    disps = p.disps.clone()
    disps[torch.rand(disps.shape, generator=g) < 0.02] = 1e-5
    prior = disps * (0.8 + 0.4 * torch.rand(disps.shape, generator=g, dtype=torch.float64))
    prior[torch.rand(disps.shape, generator=g) < 0.5] = 0.0
    p = replace(
        p, fixed=fixed, weight=weight, disps=disps, damping=torch.full_like(disps, 1e-2),
        prior=pick(None, prior), prior_weight=0.2,
    )  # fmt: skip
    if pick(False, True):
        target = p.target.clone()
        target[0, 1, 1] = float("nan")
        weight = p.weight.clone()
        weight[-1, 0, 2, -1] = float("inf")  # the cross term, where there is one
        p = replace(p, target=target, weight=weight)
    return p


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("seed", range(16))
def test_one_step_on_a_random_problem(make, cast, tested, seed, dtype):
    name, backend = tested
    exact = cast(cast(random_problem(make, seed), dtype), torch.float64)  # what float32 can hold
    expected = TorchBundleAdjuster().step(exact)
    device = "cuda" if name == "cuda" else "cpu"
    adjuster = backend()
    got = adjuster.step(cast(exact, dtype, device))
    assert got.report.status == expected.report.status
    assert got.report.dropped == expected.report.dropped
    assert got.report.isolated == expected.report.isolated
    share = 1e-9 if dtype == torch.float64 else 1e-4
    assert got.report.cost_before == pytest.approx(expected.report.cost_before, rel=share)
    assert got.report.step_norm == pytest.approx(expected.report.step_norm, rel=share, abs=1e-9)
    for field in ("T_cw", "disps"):
        start, end = getattr(exact, field), getattr(expected, field)
        moved = float((end - start).abs().max())
        error = float((getattr(got, field).cpu().double() - end).abs().max())
        size = float(end.abs().max())
        # the step itself, and the rounding of what it is added to
        assert error <= share * moved + 4 * torch.finfo(dtype).eps * size, (field, error / moved)
    again = adjuster.step(cast(exact, dtype, device))
    assert torch.equal(again.T_cw, got.T_cw)
    assert torch.equal(again.disps, got.disps)


def error_of(end, truth):
    centres = se3.inv(end.T_cw.cpu().double())[:, :3].numpy()
    moved = umeyama(centres, truth).apply(centres)
    return float(((moved - truth) ** 2).sum(1).mean() ** 0.5)


def converged(adjuster, problem, steps=10):
    for _ in range(steps):
        result = adjuster.step(problem)
        problem = replace(problem, T_cw=result.T_cw, disps=result.disps)
    return problem


@pytest.mark.parametrize("cross", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_the_error_at_convergence(make, cast, tested, seed, cross):
    name, backend = tested
    p, T_cw, _ = make(
        n=7, h=12, w=16, reach=3, noise=0.02, seed=seed, lm=1e-4, ep=1e-3, cross=cross
    )
    g = torch.Generator().manual_seed(seed)
    target = p.target + 0.2 * torch.randn(p.target.shape, generator=g, dtype=torch.float64)
    p = replace(p, target=target, damping=torch.full_like(p.disps, 1e-3), huber=0.5)
    truth = se3.inv(T_cw)[:, :3].numpy()
    reference = error_of(converged(TorchBundleAdjuster(), p), truth)
    device = "cuda" if name == "cuda" else "cpu"
    found = error_of(converged(backend(), cast(p, torch.float32, device)), truth)
    assert reference > 1e-4  # the noise leaves something to compare
    assert found == pytest.approx(reference, rel=0.02)
