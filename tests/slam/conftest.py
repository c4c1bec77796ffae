"""Keyframes of a camera on its way through a wavy scene, exact and without pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.geometry.projective import pixel_grid
from droidw.geometry.se3 import exp
from droidw.graph.store import KeyframeInfo, KeyframeStore


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
