"""Correlation against its definition, one cell and one offset at a time."""

from __future__ import annotations

import math

import pytest
import torch

from droidw_plugins.correspondence import _droid_corr
from droidw_plugins.correspondence._droid_corr import Pyramid, lookup, lookup_lowmem, volume


def features(h, w, seed):
    return torch.randn(128, h, w, generator=torch.Generator().manual_seed(seed))


def plain(fmap_i, fmap_j, coords, cell, level, dx, dy):
    """Correlation of one cell with one place, four taps by hand."""
    pooled = fmap_j
    for _ in range(level):
        h, w = pooled.shape[1] // 2 * 2, pooled.shape[2] // 2 * 2
        quarter = pooled[:, :h, :w].reshape(128, h // 2, 2, w // 2, 2)
        pooled = quarter.mean(dim=(2, 4))
    y, x = cell
    at_x = float(coords[y, x, 0]) / 2**level + dx
    at_y = float(coords[y, x, 1]) / 2**level + dy
    total = 0.0
    for ty in (math.floor(at_y), math.floor(at_y) + 1):
        for tx in (math.floor(at_x), math.floor(at_x) + 1):
            if 0 <= ty < pooled.shape[1] and 0 <= tx < pooled.shape[2]:
                share = (1 - abs(at_x - tx)) * (1 - abs(at_y - ty))
                total += share * float(fmap_i[:, y, x] @ pooled[:, ty, tx]) / 16
    return total


@pytest.mark.parametrize(("h", "w"), [(8, 8), (9, 13), (17, 10)])
def test_definition_and_order_of_channels(h, w):
    a, b = features(h, w, 1), features(h, w, 2)
    g = torch.Generator().manual_seed(3)
    coords = torch.rand(h, w, 2, generator=g) * torch.tensor([w + 8.0, h + 8.0]) - 4
    pyramid = Pyramid(h, w)
    found = lookup([volume(a, pyramid.features(b))], coords[None], pyramid)[0]
    assert found.shape == (196, h, w)
    for y, x, level, dx, dy in [
        (0, 0, 0, -3, 2), (h - 1, w - 1, 0, 3, -1), (2, 3, 1, 0, 0), (4, 1, 1, 2, -3),
        (h - 2, 2, 2, 1, 1), (5, w - 3, 3, -1, 0), (3, 3, 3, 0, 1),
    ]:  # fmt: skip
        channel = 49 * level + 7 * (dx + 3) + (dy + 3)
        expected = plain(a, b, coords, (y, x), level, dx, dy)
        assert float(found[channel, y, x]) == pytest.approx(expected, abs=2e-5)


def test_low_memory_gives_the_same(monkeypatch):
    h, w = 11, 14
    pyramid = Pyramid(h, w)
    maps = [features(h, w, k) for k in range(3)]
    edges = [(0, 1), (1, 0), (2, 0), (2, 1)]
    coords = torch.rand(4, h, w, 2, generator=torch.Generator().manual_seed(9)) * 16 - 1
    columns = [pyramid.features(m) for m in maps]
    kept = lookup([volume(maps[i], columns[j]) for i, j in edges], coords, pyramid)
    pairs = [(maps[i], columns[j]) for i, j in edges]
    assert torch.allclose(lookup_lowmem(pairs, coords, pyramid), kept, atol=1e-5)
    # also where only a few rows of a volume fit into memory
    monkeypatch.setattr(_droid_corr, "_ROOM", {"cpu": 5 * pyramid.columns, "cuda": 1})
    assert torch.allclose(lookup_lowmem(pairs, coords, pyramid), kept, atol=1e-5)


def test_half_precision_volumes_are_looked_up_with_exact_coordinates():
    h, w = 12, 16
    pyramid = Pyramid(h, w)
    exact = volume(features(h, w, 1), pyramid.features(features(h, w, 2)))
    coords = torch.rand(1, h, w, 2) * 10
    found = lookup([exact.half()], coords, pyramid)
    expected = lookup([exact], coords, pyramid)
    assert float((found - expected).norm() / expected.norm()) < 1e-3
    assert found.dtype == torch.float32


def test_far_outside_is_nothing():
    h, w = 8, 10
    pyramid = Pyramid(h, w)
    one = volume(features(h, w, 1), pyramid.features(features(h, w, 2)))
    for far in (-1e9, -60.0, 75.0, 3e38):
        assert not lookup([one], torch.full((1, h, w, 2), far), pyramid).any()


def test_edges_worked_out_together(monkeypatch):
    h, w = 9, 8
    pyramid = Pyramid(h, w)
    volumes = [volume(features(h, w, k), pyramid.features(features(h, w, k + 1))) for k in range(5)]
    coords = torch.rand(5, h, w, 2) * 8
    one_by_one = lookup(volumes, coords, pyramid)
    monkeypatch.setattr(_droid_corr, "_TOGETHER", {"cpu": 3, "cuda": 3})
    assert torch.equal(lookup(volumes, coords, pyramid), one_by_one)
