"""The scale that a depth prior gives to a result."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.slam.focal import FocalSearch
from droidw.slam.metric import deeper, scale_to_prior

H, W, COUNT, DRIFT = 8, 12, 5, 1.17


@pytest.fixture
def drifted(arc, waves, stored):
    """A store whose scale has drifted, and what it was before."""
    grid, intrinsics = Grid(H, W, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5])
    T_cw, disps = arc(COUNT), waves(COUNT, H, W)
    smaller = T_cw.clone()
    smaller[:, :3] /= DRIFT
    store = stored(grid, intrinsics, smaller, DRIFT * disps)
    store["prior"].copy_(disps)
    store.infos[1].disp_full = np.full((8 * H, 8 * W), DRIFT, np.float32)
    return store, T_cw, disps


def test_poses_and_depths_get_the_scale_of_the_prior(drifted):
    store, T_cw, disps = drifted
    valid = torch.ones(COUNT, H, W, dtype=torch.bool)
    assert scale_to_prior(store, valid) == pytest.approx(DRIFT, rel=1e-5)
    torch.testing.assert_close(store.T_cw, T_cw)
    torch.testing.assert_close(store.disps, disps)
    np.testing.assert_allclose(store.infos[1].disp_full, 1.0, rtol=1e-5)


def test_what_is_unknown_or_unconfirmed_or_stray_has_no_say(drifted):
    store, T_cw, disps = drifted
    valid = torch.ones(COUNT, H, W, dtype=torch.bool)
    valid[:, :, : W // 2 + 1] = False
    store.disps[:, :, : W // 2 + 1] = disps[:, :, : W // 2 + 1]  # as the prior had it
    store["prior"][:, :2] = 0.0
    store["prior"][:, 3, W - 1] *= 50.0
    assert scale_to_prior(store, valid) == pytest.approx(DRIFT, rel=1e-5)
    torch.testing.assert_close(store.T_cw, T_cw)


@pytest.mark.parametrize("lacks", ["prior", "valid", "all but a few"])
def test_where_next_to_nothing_is_known_nothing_changes(drifted, lacks):
    store, _, _ = drifted
    valid = torch.full((COUNT, H, W), lacks != "valid")
    if lacks == "prior":
        store["prior"].zero_()
    if lacks == "all but a few":
        valid[1:] = False
    before = store.T_cw.clone(), store.disps.clone()
    factor = scale_to_prior(store, valid)
    assert factor == 1.0 and math.isfinite(factor)
    assert torch.equal(store.T_cw, before[0]) and torch.equal(store.disps, before[1])


def test_a_prior_that_goes_with_the_focal_length_follows_it(drifted):
    store, T_cw, disps = drifted
    valid, found = torch.ones(COUNT, H, W, dtype=torch.bool), FocalSearch(0.8, ())
    measured = SimpleNamespace(metric=True)
    network = SimpleNamespace(metric=True, goes_with_focal=True)
    says_no = SimpleNamespace(metric=True, goes_with_focal=False)
    assert deeper(measured, found) == deeper(says_no, found) == deeper(network, None) == 1.0
    assert scale_to_prior(store, valid, deeper(network, found)) == pytest.approx(0.8 * DRIFT)
    torch.testing.assert_close(store.T_cw[:, :3], 0.8 * T_cw[:, :3])
    torch.testing.assert_close(store.disps, disps / 0.8)
