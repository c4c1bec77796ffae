"""The search for a better focal length."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import CameraConfig, PhaseConfig, SolverConfig, WeightingConfig
from droidw.geometry import projective, se3
from droidw.geometry.camera import Grid
from droidw.graph.factors import FactorGraph
from droidw.graph.proximity import neighbour_edges
from droidw.slam.focal import minimise_with_prior, refine_focal
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.timing import Stopwatch
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

PHASE = PhaseConfig(updates=1, iterations=2, learn=False, weigh=False, depth_prior=False)
SOLVER = SolverConfig(lm=1e-6, ep=1e-6, huber=0.0)


def valley(x):
    return 100.0 * (1.0 + 8.0 * (x - 0.08) ** 2 + 5.0 * (x - 0.08) ** 3)


def test_without_prior_the_valley_is_found():
    x, tried = minimise_with_prior(valley, trust=0.0, bound=0.3)
    assert x == pytest.approx(0.08, abs=0.004)
    assert len(tried) <= 8 and tried[0] == (0.0, valley(0.0))


def test_prior_pulls_back_by_the_ratio_of_curvatures():
    def energy(x):
        return 100.0 * (1.0 + 8.0 * (x - 0.08) ** 2)

    at_zero = energy(0.0) / 100.0
    x, _ = minimise_with_prior(energy, trust=10.0, bound=0.3)
    assert x == pytest.approx(0.08 * 16.0 / (16.0 + 10.0 * at_zero), abs=1e-3)


def test_bound_holds_on_a_slope():
    x, _ = minimise_with_prior(lambda x: 2.0 - x, trust=0.0, bound=0.25)
    assert x == pytest.approx(0.25)


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_energy_that_is_not_finite_ends_the_search(broken):
    x, tried = minimise_with_prior(lambda x: 1.0 if x == 0 else broken, trust=1.0, bound=0.3)
    assert x == 0.0 and len(tried) == 3


@pytest.fixture
def bench(waves, stored):
    """`bench(wrong=)`: an optimiser over 12 keyframes with exact measurements, and a focal length
    that is `wrong` times the true one.
    """

    def make(wrong):
        h, w, count = 12, 16, 12
        grid = Grid(h, w, 8, 3.5)
        true = torch.tensor([110.0, 110.0, 63.5, 47.5])
        given = true * torch.tensor([wrong, wrong, 1.0, 1.0])
        s = torch.linspace(0, 1, count)
        across = (0.8 * (5 * s).sin(), 0.3 * (7 * s).cos(), 0.2 * s)
        turn = (0.2 * s.cos(), 0.5 * (4 * s).sin(), 0.1 * s)
        T_cw = se3.exp(torch.stack((*across, *turn), 1))
        disps = waves(count, h, w)
        store = stored(grid, given, T_cw, disps)
        graph = FactorGraph(h, w, store.device)
        graph.add(neighbour_edges(count, 3))
        ii, jj = graph.index(graph.select())
        graph.target[:], valid = projective.reproject(T_cw, disps, grid.intrinsics(true), ii, jj)
        graph.confidence[:] = valid[..., None].float()
        parts = Parts(None, None, None, TorchBundleAdjuster(), None)
        return Optimiser(store, parts, WeightingConfig(), Stopwatch()), graph, true

    return make


def test_a_wrong_focal_length_is_found_from_exact_measurements(bench):
    optimiser, graph, true = bench(wrong=1.08)
    camera = CameraConfig(focal_trust=0.0)
    found = refine_focal(optimiser, graph, PHASE, SOLVER, camera, known=True)
    assert found.factor == pytest.approx(1 / 1.08, rel=0.01)
    store = optimiser.store
    assert float(store.image_intrinsics[0]) == pytest.approx(float(true[0]), rel=0.01)
    assert torch.allclose(store.intrinsics, store.grid.intrinsics(store.image_intrinsics))
    assert torch.equal(store.image_intrinsics[2:], true[2:])


def test_what_lines_say_goes_by_the_focal_length_that_is_tried(bench):
    optimiser, graph, true = bench(wrong=1.08)
    tried, last = [], []
    intrinsics = optimiser.store.image_intrinsics
    optimiser.upright.refit = lambda: tried.append(float(intrinsics[0] / true[0])) or 0.0
    optimiser.upright.measure = lambda: last.append(float(intrinsics[0] / true[0]))
    found = refine_focal(optimiser, graph, PHASE, SOLVER, CameraConfig(focal_trust=0.0), known=True)
    assert tried == pytest.approx([1.08 * factor for factor, _ in found.tried], rel=1e-5)
    assert last == pytest.approx([1.08 * found.factor], rel=1e-5)


@pytest.mark.parametrize(("count", "leads_to"), [(0.0, 1.0), (1e8, 1.03)])
def test_what_lines_are_off_counts_in_the_search(bench, count, leads_to):
    """Where they are off least at 1.03 times the true focal length."""
    optimiser, graph, true = bench(wrong=1.08)
    graph.target[:] += 0.1 * torch.randn(graph.target.shape, generator=torch.manual_seed(0))
    intrinsics = optimiser.store.image_intrinsics

    def refit():
        return count * math.log(float(intrinsics[0] / true[0]) / 1.03) ** 2

    optimiser.upright = SimpleNamespace(
        holds=True,
        term=lambda *_: None,
        flat=lambda problem, *_: problem,
        refit=refit,
        measure=lambda: None,
    )
    found = refine_focal(optimiser, graph, PHASE, SOLVER, CameraConfig(focal_trust=0.0), known=True)
    assert 1.08 * found.factor == pytest.approx(leads_to, abs=0.012)


def test_a_right_focal_length_stays(bench):
    optimiser, graph, _ = bench(wrong=1.0)
    found = refine_focal(optimiser, graph, PHASE, SOLVER, CameraConfig(), known=True)
    assert found.factor == pytest.approx(1.0, abs=0.003)


@pytest.mark.parametrize("known", [True, False])
def test_a_calibration_that_is_off_by_less_than_the_search_is_exact_stays(bench, known):
    for wrong, kept in ((1.006, known), (1.02, False)):
        optimiser, graph, true = bench(wrong=wrong)
        camera = CameraConfig(focal_trust=0.0)
        found = refine_focal(optimiser, graph, PHASE, SOLVER, camera, known)
        factor = float(optimiser.store.image_intrinsics[0] / true[0]) / wrong
        assert found.factor == pytest.approx(factor, rel=1e-5)
        assert (found.factor == 1.0) is kept
        if not kept:
            assert found.factor * wrong == pytest.approx(1.0, abs=0.003)


@pytest.mark.parametrize(("noise", "moves"), [(0.02, True), (1.0, False)])
def test_a_calibration_stays_where_measurements_hold_it_less_than_its_prior(bench, noise, moves):
    """Noise is energy, and beside more of it the same valley is shallower."""
    for known in (True, False):
        optimiser, graph, _ = bench(wrong=1.08)
        drawn = torch.randn(graph.target.shape, generator=torch.Generator().manual_seed(0))
        graph.target += noise * drawn
        camera = CameraConfig(focal_slack=0.0)
        found = refine_focal(optimiser, graph, PHASE, SOLVER, camera, known)
        (_, at_zero), (factor, right), (_, left) = found.tried[:3]
        trust = camera.focal_trust * (1.0 if known else 0.1)
        own = (right + left) / at_zero - 2 - trust * math.log(factor) ** 2
        assert (own > 10.0 * math.log(factor) ** 2) is moves
        assert (found.factor == 1.0) is (known and not moves)


def test_a_guess_moves_where_a_calibration_holds(bench):
    factors = []
    for known in (True, False):
        optimiser, graph, _ = bench(wrong=1.08)
        # noise, without which any prior is weak beside an energy of zero
        noise = torch.randn(graph.target.shape, generator=torch.Generator().manual_seed(0))
        graph.target += 0.15 * noise
        camera = CameraConfig(focal_trust=100.0)
        found = refine_focal(optimiser, graph, PHASE, SOLVER, camera, known)
        factors.append(abs(math.log(found.factor)))
    assert factors[0] < factors[1]


def test_the_search_gives_up_no_measurement(bench):
    found = []
    for cauchy in (0.0, 0.05):
        optimiser, graph, _ = bench(wrong=1.08)
        solver = replace(SOLVER, cauchy=cauchy)
        camera = CameraConfig(focal_trust=0.0)
        found.append(refine_focal(optimiser, graph, PHASE, solver, camera, known=True))
    assert found[0] == found[1]
