"""How far all keyframes are apart."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.geometry.projective import frame_distance
from droidw.slam import apart

COUNT, BETA = 9, 0.3


@pytest.fixture
def store(arc, waves, stored):
    h, w = 30, 40
    grid, intrinsics = Grid(h, w, 8, 3.5), torch.tensor([280.0, 280.0, 159.5, 119.5])
    return stored(grid, intrinsics, arc(COUNT), waves(COUNT, h, w))


def test_it_is_the_frame_distance_of_each_pair(store):
    found = apart.distances_between(store, [0, 2, 5], BETA)
    exact = frame_distance(
        store.T_cw, store.disps, store.intrinsics, torch.tensor([2, 5, 5]), torch.tensor([0, 0, 2]),
        BETA,
    )  # fmt: skip
    assert found[[1, 2, 2], [0, 0, 1]].tolist() == exact.double().tolist()
    assert np.isinf(found[np.triu_indices(3)]).all()


def test_of_many_some_cells_tell(store, monkeypatch):
    every = range(COUNT)
    exact = apart.distances_between(store, every, BETA)
    monkeypatch.setattr(apart, "_MANY", COUNT - 1)
    some = apart.distances_between(store, every, BETA)
    below = np.tril_indices(COUNT, -1)
    assert not np.array_equal(some[below], exact[below])
    np.testing.assert_allclose(some[below], exact[below], rtol=0.03)


def test_one_keyframe_or_none_has_no_pairs(store):
    assert apart.distances_between(store, [3], BETA).shape == (1, 1)
    assert apart.distances_between(store, [], BETA).shape == (0, 0)
