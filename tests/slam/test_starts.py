"""Starts of the first bundle adjustment, and what a new keyframe takes over from the last."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import SolverConfig
from droidw.geometry import projective, se3
from droidw.slam.frontend import Frontend
from droidw.slam.locate import carry_depth
from droidw.slam.starts import mirrored, plane_starts

K = torch.tensor([20.0, 20.0, 7.5, 5.5])


def test_mirrored_keeps_the_flow_of_a_distant_scene():
    """Depth inside out and motion the other way: the flow differs in the second order only."""
    h, w = 12, 16
    x, y = projective.pixel_grid(h, w).unbind(-1)
    relief = 0.1 * (0.7 * x).sin() * (0.5 * y).cos()
    disps = torch.stack([0.5 + relief, 0.5 + relief])
    step = torch.tensor([[0.0] * 6, [0.05, 0.02, 0.0, 0.0, 0.0, 0.0]])
    T_cw = se3.exp(step)
    ii, jj = torch.tensor([0]), torch.tensor([1])
    flow, _ = projective.reproject(T_cw, disps, K, ii, jj)
    other, _ = projective.reproject(*mirrored(T_cw, disps), K, ii, jj)
    still = projective.pixel_grid(h, w)
    middle = (slice(4, 8), slice(6, 10))
    difference = (flow - other)[0][middle].abs().max()
    assert difference < 0.1 * (flow[0] - still)[middle].abs().max()


def test_plane_starts_cover_rest_and_six_ways():
    starts = list(plane_starts(torch.zeros(4, 3, 5)))
    assert len(starts) == 7
    ways = {tuple(T_cw[-1, :3].sign().tolist()) for T_cw, _ in starts}
    assert len(ways) == 7 and (0.0, 0.0, 0.0) in ways
    for T_cw, disps in starts:
        assert torch.equal(T_cw[0, :3], torch.zeros(3))
        assert torch.equal(disps, torch.ones(4, 3, 5))


def test_carried_depth_is_that_of_the_other_camera():
    """A plane square to the axis at depth 2, seen from half a unit nearer: depth 1.5."""
    disps = torch.full((12, 16), 0.5)
    T_cw = se3.exp(torch.tensor([[0.0] * 6, [0.0, 0.0, -0.5, 0.0, 0.0, 0.0]]))
    carried = carry_depth(disps, T_cw, K)
    assert torch.allclose(carried, torch.full_like(carried, 1 / 1.5), rtol=1e-4)


def test_carried_depth_fills_what_comes_into_view_and_keeps_the_nearest():
    disps = torch.full((12, 16), 0.2)
    disps[:, 8:] = 1.0
    T_cw = se3.exp(torch.tensor([[0.0] * 6, [-0.2, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    carried = carry_depth(disps, T_cw, K)
    assert bool((carried > 0).all()) and float(carried.max()) <= 1.0 + 1e-6
    assert torch.allclose(carried[:, 4:12], torch.ones(12, 8))  # moved four cells to the left


def test_carried_depth_without_any_overlap_is_the_old_one():
    disps = torch.full((12, 16), 0.5)
    T_cw = se3.exp(torch.tensor([[0.0] * 6, [50.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    assert torch.equal(carry_depth(disps, T_cw, K), disps)


@pytest.mark.parametrize(("closed", "cauchy"), [(0.0, 0.0), (0.01, 0.0), (0.05, 0.15)])
def test_far_matches_are_given_up_at_first_only_where_it_is_known_what_can_move(closed, cauchy):
    gates = torch.ones(8, 10, 10)
    gates.view(-1)[: round(closed * gates.numel())] = 0.1
    frontend = Frontend.__new__(Frontend)
    frontend.config = SimpleNamespace(solver=SolverConfig(huber=0.2, cauchy=0.15, cauchy_slip=1.0))
    frontend.optimiser = SimpleNamespace(gates=lambda learned: gates)
    solver = frontend._first_solver()
    assert solver.cauchy == cauchy
    assert cauchy == 0 or solver.cauchy_slip == 0  # along lines everything slips at first
    assert solver.huber == 0.2
