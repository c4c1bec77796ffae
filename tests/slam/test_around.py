"""A start whose world surrounds what moves, where as much is matched on that as on the world."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import DroidwConfig, FrontendConfig, SolverConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import exp
from droidw.graph.factors import FactorGraph
from droidw.graph.proximity import neighbour_edges
from droidw.slam import starts
from droidw.slam.frontend import Frontend
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.starts import Trials
from droidw.slam.timing import Stopwatch
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

H, W, COUNT = 12, 16, 5
KERNEL = 0.15
SOLVER = SolverConfig(huber=0.2, cauchy=0.0)


@pytest.fixture
def behind_a_van(waves, stored):
    """`behind_a_van(much)`: a drive behind a van of two ninths of the picture, with so much
    confidence as a multiple of that of the street. Poses and depths are those of a world that
    moves with the van. Returns the trials and the true poses.
    """

    def make(much):
        grid, intrinsics = Grid(H, W, 8, 3.5), torch.tensor([110.0, 110.0, 63.5, 47.5])
        s = torch.linspace(0, 1, COUNT)[:, None]
        T_cw = exp(s * torch.tensor([0.02, 0.0, -0.5, 0.0, 0.02, 0.0]))
        disps = waves(COUNT, H, W)
        van = torch.zeros(H, W, dtype=torch.bool)
        van[3:9, 4:11] = True
        with_it = exp(s * torch.tensor([-0.06, 0.0, 0.1, 0.0, 0.0, 0.0]))
        nearer = torch.full_like(disps, 1.3)
        store = stored(grid, intrinsics, with_it, nearer)
        graph = FactorGraph(H, W, store.device)
        graph.add(neighbour_edges(COUNT, 3))
        ends = graph.index(graph.select())
        street, seen = reproject(T_cw, disps, grid.intrinsics(intrinsics), *ends)
        ahead, _ = reproject(with_it, nearer, grid.intrinsics(intrinsics), *ends)
        graph.target[:] = torch.where(van[None, ..., None], ahead, street)
        graph.confidence[:] = torch.where(van, float(much), 1.0)[None, ..., None]
        graph.confidence[:] *= (seen | van)[..., None]
        parts = Parts(None, None, None, TorchBundleAdjuster(), None)
        config = DroidwConfig()
        optimiser = Optimiser(store, parts, config.weighting, Stopwatch())
        return Trials(optimiser, graph, config.schedule, SOLVER), T_cw

    return make


def along(trials, T_cw) -> float:
    """Cosine between the way to the last keyframe and the true one."""
    ways = [T[-1, :3] / T[-1, :3].norm() for T in (trials.optimiser.store.T_cw, T_cw)]
    return float(ways[0] @ ways[1])


def test_the_street_is_found_behind_a_van_that_has_half_of_the_matches(behind_a_van):
    trials, T_cw = behind_a_van(3.0)
    assert along(trials, T_cw) < -0.8
    assert trials.around(KERNEL, 1.1)
    assert along(trials, T_cw) > 0.95


def test_what_was_found_stays_to_the_bit_if_nothing_reaches_as_far(behind_a_van):
    trials, _ = behind_a_van(3.0)
    store = trials.optimiser.store
    before = store.T_cw.clone(), store.disps.clone()
    assert not trials.around(KERNEL, 100.0)
    assert torch.equal(store.T_cw, before[0]) and torch.equal(store.disps, before[1])


def test_starts_begin_steady_and_narrow_and_so_does_what_was_found(behind_a_van, monkeypatch):
    trials, _ = behind_a_van(3.0)
    store, calls = trials.optimiser.store, []
    before = store.disps.clone()

    def adjusted(self, phase, solver, steady=0.0):
        calls.append((round(solver.cauchy / KERNEL), steady))
        store.disps[:] += 1.0

    reached = iter((0.7, 0.9, *[0.95] * 7))
    monkeypatch.setattr(Trials, "_adjust", adjusted)
    monkeypatch.setattr(starts, "explained_reach", lambda *_: next(reached))
    assert trials.around(KERNEL, 1.1)
    narrowing = [(8, 100.0), (4, 33.0), (1, 0.0)]
    assert calls == [(1, 0.0), *narrowing, *([(0, 100.0), *narrowing] * 7)]
    assert torch.equal(store.disps, before + 3.0)  # what was found, once it has narrowed as well


def test_the_street_itself_is_not_left(behind_a_van):
    trials, T_cw = behind_a_van(3.0)
    trials.optimiser.store.T_cw[:] = T_cw
    trials.optimiser.store.disps[:] = 0.6
    assert not trials.around(KERNEL, 1.1)
    assert torch.equal(trials.optimiser.store.T_cw, T_cw)


@pytest.mark.parametrize(
    ("cauchy", "known", "surrounds", "lines", "asked"),
    [
        (0.15, False, 1.1, False, True),
        (0.15, True, 1.1, False, True),
        (0.0, False, 1.1, False, False),
        (0.15, False, 0.0, False, False),
        (0.15, True, 1.1, True, False),
    ],
)
def test_it_is_asked_where_there_is_a_kernel_to_narrow(
    monkeypatch, cauchy, known, surrounds, lines, asked
):
    config = DroidwConfig(frontend=FrontendConfig(surrounds=surrounds))
    config = replace(config, solver=replace(config.solver, cauchy=cauchy))
    frontend = Frontend.__new__(Frontend)
    frontend.config, frontend.options = config, config.frontend
    frontend._solver = replace(config.solver, cauchy=cauchy if known else 0.0)
    calls = []
    monkeypatch.setattr(Trials, "again", lambda self: False)
    monkeypatch.setattr(Trials, "around", lambda self, *a: calls.append(a) or True)
    monkeypatch.setattr(Frontend, "_updates", lambda self, phase, first_free: calls.append(phase))
    frontend.optimiser, frontend.graph = SimpleNamespace(upright=SimpleNamespace(holds=lines)), None
    frontend._try_others()
    assert calls == ([(cauchy, surrounds), "init"] if asked else [])
    assert frontend._solver.cauchy == (cauchy if known or asked else 0.0)
