"""The keyframe store: it grows, and removing a keyframe moves every field of the others."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.errors import PluginError
from droidw.geometry.camera import Grid
from droidw.graph.store import KeyframeInfo, KeyframeStore
from droidw.interfaces.uncertainty import StoreField

GRID = Grid(3, 4, 8, 3.5)
EXTRA = (StoreField("own", (2, "h")), StoreField("count", (), fill=7, dtype="int64"))
FIELDS = (
    "T_cw", "disps", "prior", "features", "uncertainty", "damping", "unmasked", "movable",
    "through", "own", "count", "axes", "axes_information",
)  # fmt: skip


def empty():
    return KeyframeStore(GRID, torch.tensor([50.0, 50.0, 16.0, 12.0]), 5, EXTRA)


def append(store, tag):
    """A keyframe whose every value is `tag`."""
    info = KeyframeInfo(tag, tag / 10, f"{tag}", np.full((1, 1, 3), tag % 256, np.uint8), tag)
    values = {name: torch.full(store[name].shape[1:], tag) for name in FIELDS}
    return store.append(info, **values)


def tags(store):
    """The tag of each keyframe, once per field; they have to agree in all values."""
    held = {}
    for name in FIELDS:
        values = [store[name][k].double().flatten() for k in range(len(store))]
        assert all((v == v[0]).all() for v in values), f"{name} is torn"
        held[name] = [int(v[0]) for v in values]
    return held


@pytest.mark.parametrize("seed", range(8))
def test_remove_moves_every_field(seed):
    rng = np.random.default_rng(seed)
    store, expected, tag = empty(), [], 1
    for _ in range(60):
        if expected and rng.random() < 0.4:
            at = int(rng.integers(len(expected)))
            store.remove(at)
            del expected[at]
        else:
            assert append(store, tag) == len(expected)
            expected.append(tag)
            tag += 1
        assert len(store) == len(expected)
        assert all(held == expected for held in tags(store).values())
        assert [info.index for info in store.infos] == expected
        assert [store.payload(k) for k in range(len(store))] == expected
        assert store.times() == [t / 10 for t in expected]


def test_sort_brings_every_field_into_the_order_of_frames():
    store, rng = empty(), np.random.default_rng(3)
    for tag in rng.permutation(21) + 1:
        append(store, int(tag))
    store.sort()
    expected = list(range(1, 22))
    assert all(held == expected for held in tags(store).values())
    assert [store.payload(k) for k in range(len(store))] == expected
    assert append(store, 22) == 21


def test_every_declared_field_is_covered_above():
    assert set(empty()._declared) == set(FIELDS)


def test_fill_values_return_after_removal():
    store = empty()
    append(store, 3)
    append(store, 4)
    store.remove(1)
    number = store.append(KeyframeInfo(9, 0.9, "", np.zeros((1, 1, 3), np.uint8), None))
    assert number == 1
    assert (store.disps[1] == 1).all()
    assert (store["prior"][1] == 0).all()
    assert (store["own"][1] == 0).all()
    assert store["count"][1] == 7
    assert (store.disps[0] == 3).all()


def test_views_write_through():
    store = empty()
    append(store, 1)
    append(store, 2)
    store.extra()["own"][1] = 5.0
    assert (store["own"][1] == 5).all()
    poses = torch.arange(14.0).reshape(2, 7)
    store.write(poses, torch.full((2, 3, 4), 0.5))
    assert torch.equal(store.T_cw, poses)
    assert (store["disps"] == 0.5).all()


@pytest.mark.parametrize("at", [-1, 2])
def test_removing_what_is_not_there(at):
    store = empty()
    append(store, 1)
    append(store, 2)
    with pytest.raises(IndexError, match="of 2"):
        store.remove(at)


def test_two_fields_of_one_name():
    with pytest.raises(PluginError, match="is there already"):
        KeyframeStore(GRID, torch.ones(4), 0, (StoreField("disps", ("h",)),))


def test_a_blank_store_is_alike_and_takes_keyframes_as_they_are():
    store = empty()
    for tag in (3, 4, 5):
        append(store, tag)
    store.intrinsics *= 1.1
    other = store.blank()
    assert len(other) == 0
    assert torch.equal(other.intrinsics, store.intrinsics)
    assert list(other.extra()) == list(store.extra())
    for index in (2, 0):
        other.append(store.infos[index], **store.values(index))
    assert all(held == [5, 3] for held in tags(other).values())
    assert other["count"].dtype == torch.int64
    other.T_cw.zero_()
    assert all(held == [3, 4, 5] for held in tags(store).values())
