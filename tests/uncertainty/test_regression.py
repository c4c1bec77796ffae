"""Ridge regression that more can be added to."""

from __future__ import annotations

import torch

from droidw_plugins.uncertainty._regression import Regression


def _drawn(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed)
    rows = torch.randn(count, 50, 3, generator=draw, dtype=torch.float64)
    return rows, torch.randn(count, 50, generator=draw, dtype=torch.float64)


def test_theta_is_that_of_ridge_regression() -> None:
    rows, y = _drawn(2, 0)
    theta = Regression.of(rows, y).theta().requires_grad_()
    found = (rows @ theta[:-1] + theta[-1] - y).square().mean()
    square = (rows.square().mean((0, 1)).sum() + 1) / 4
    (slope,) = torch.autograd.grad(found + 0.1 * square * theta.square().sum(), theta)
    assert float(slope.abs().max()) < 1e-12


def test_more_that_is_added_counts_as_if_it_had_been_there() -> None:
    rows, y = _drawn(4, 1)
    parts = Regression.of(rows[:1], y[:1]).and_then(Regression.of(rows[1:], y[1:]), 1.0)
    assert torch.allclose(parts.theta(), Regression.of(rows, y).theta(), atol=1e-12)


def test_what_was_there_fades() -> None:
    (old, before), (rows, y) = _drawn(1, 2), _drawn(1, 3)
    found = Regression.of(old, before).and_then(Regression.of(rows, y), 0.0)
    assert torch.allclose(found.theta(), Regression.of(rows, y).theta(), atol=1e-12)
    twice = Regression.of(torch.cat([old, rows, rows]), torch.cat([before, y, y]))
    half = Regression.of(old, before).and_then(Regression.of(rows, y), 0.5)
    assert torch.allclose(half.theta(), twice.theta(), atol=1e-12)
