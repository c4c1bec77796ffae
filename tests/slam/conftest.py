"""Keyframes of a camera on its way through a wavy scene, exact and without pictures."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from droidw.config.schema import CameraConfig, DroidwConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import pixel_grid, reproject
from droidw.geometry.se3 import exp, mul
from droidw.graph.store import KeyframeInfo, KeyframeStore
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam.backend import Backend
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.timing import Stopwatch
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

# Of `broken`: cells, keyframes, and those that have broken off.
H, W, COUNT, BROKEN = 8, 12, 9, 3
LIARS = 0.2  # share of the cells that agree with the break


@pytest.fixture
def arc():
    """`arc(count)`: poses T_cw [count,7] of a camera that moves along a bend and turns a little."""

    def make(count):
        s = torch.linspace(0, 1, count)
        return exp(torch.stack([0.8 * s, 0.3 * s * s, 0.1 * s, 0.1 * s, 0.2 * s, 0.1 * s], 1))

    return make


@pytest.fixture
def waves():
    """`waves(count, h, w)`: disparities [count,h,w] around 0.6, another wave in every keyframe."""

    def make(count, h, w):
        x, y = pixel_grid(h, w).unbind(-1)
        return torch.stack([0.6 + 0.2 * (0.6 * x + k).sin() + 0.1 * y.cos() for k in range(count)])

    return make


@pytest.fixture
def stored():
    """`stored(grid, intrinsics, T_cw, disps)`: a store with a blank keyframe for each pose."""

    def make(grid, intrinsics, T_cw, disps):
        store = KeyframeStore(grid, intrinsics)
        blank = np.zeros((grid.height * grid.stride, grid.width * grid.stride, 3), np.uint8)
        for k, (pose, disp) in enumerate(zip(T_cw, disps, strict=True)):
            store.append(KeyframeInfo(k, k / 10, "", blank, None), T_cw=pose, disps=disp)
        return store

    return make


@pytest.fixture
def broken(arc, waves, stored):
    """`broken(cauchy=, focal=, **backend)`: a backend whose first keyframes have broken off.

    And what tells its largest residual, cells. Measurements are exact, but that some of those
    across the break agree with it, as matches do that follow what moves.
    """
    grid, intrinsics = Grid(H, W, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5])
    T_cw, disps = arc(COUNT), waves(COUNT, H, W)
    off = exp(torch.tensor([0.1, -0.05, 0.0, 0.05, 0.1, 0.05])).expand(BROKEN, -1)

    lies = torch.rand(H, W, generator=torch.Generator().manual_seed(0)) < LIARS
    start = torch.cat([mul(off, T_cw[:BROKEN]), T_cw[BROKEN:]])

    def measured(ii, jj, poses=T_cw):
        return reproject(poses, disps, grid.intrinsics(intrinsics), ii, jj)

    def answer(request):
        ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
        target, valid = measured(ii, jj)
        wrong = ((ii < BROKEN) != (jj < BROKEN))[:, None, None] & lies
        target = torch.where(wrong[..., None], measured(ii, jj, start)[0], target)
        return EdgeUpdate(target, valid[..., None].float().expand_as(target).contiguous())

    def blind(request):
        # some noise, and nothing at all across the break
        found = answer(request)
        ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
        noise = torch.randn(found.target.shape, generator=torch.Generator().manual_seed(1))
        seen = ((ii < BROKEN) == (jj < BROKEN))[:, None, None, None]
        return EdgeUpdate(found.target + 0.02 * noise, found.confidence * seen)

    def leaning(request):
        # some noise, and a third of the cells is off alike, by a few times as much
        ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
        target, valid = measured(ii, jj)
        g = torch.Generator().manual_seed(2)
        noise = 0.01 * torch.randn(target.shape, generator=g)
        slipped = torch.rand(H, W, generator=g)[..., None] < 1 / 3
        alike = slipped * torch.tensor([0.0, -0.06]) * (jj - ii)[:, None, None, None]
        sure = valid[..., None].float().expand_as(target).contiguous()
        return EdgeUpdate(target + noise + alike, sure)

    def call(cauchy=0.75, focal=False, joined=True, leans=False, **backend):
        config = DroidwConfig(camera=CameraConfig(refine_focal=focal))
        config.global_solver.cauchy = cauchy
        config.backend = replace(config.backend, **backend)
        store = stored(grid, intrinsics.clone(), start, disps)
        operator = SimpleNamespace(
            session=lambda purpose: SimpleNamespace(
                update=leaning if leans else answer if joined else blind
            )
        )
        parts = Parts(None, None, None, TorchBundleAdjuster(), operator)
        optimiser = Optimiser(store, parts, config.weighting, Stopwatch())

        def residual():
            ii, jj = torch.arange(COUNT - 1), torch.arange(1, COUNT)
            target, valid = measured(ii, jj)
            coords, _ = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
            return float(((coords - target).norm(dim=-1) * valid).mean(dim=(1, 2)).max())

        return Backend(optimiser, config), residual

    return call
