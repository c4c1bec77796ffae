"""benchmarks/match_bias.py knows where cells are seen, and takes means as it says."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return importlib.import_module("match_bias")


@pytest.fixture
def street(script):
    """The street at half the size."""
    part = script.FlowCorrespondence(script.FlowOptions(workers=1))
    return script.Known("street", 11, (160, 88), part)


def test_a_point_goes_where_it_came_from(street):
    there, shown = street.flow(20, 22)
    assert 0.4 < shown.mean() < 1
    to = street.cells + there
    back, _ = street.flow(22, 20)
    # Flow at the place itself, between cells, is about that of the nearest one.
    cell = np.rint((to - street._flow.offset) / street._flow.stride).astype(int)
    height, width = shown.shape
    x, y = cell[..., 0].clip(0, width - 1), cell[..., 1].clip(0, height - 1)
    apart = np.linalg.norm(there + back[y, x], axis=-1)[shown]
    assert np.median(apart) < 0.5 < 2 < np.median(np.linalg.norm(there, axis=-1)[shown])


def test_matches_are_near_the_truth(street, script):
    for rows in street.errors(20, 21):
        median, along, down = script.biases(rows)
        assert len(rows) > 40 and median < 0.3 and abs(along) < 0.02 and abs(down) < 0.1


def test_means_are_weighted_and_strays_do_not_count(script):
    flow, good = np.array([[10.0, 0.0], [0.0, 20.0]]), np.array([[0.01, 0.0], [0.0, 0.02]])
    stray = np.array([[3.0, 3.0, 10.0, 0.0, 1.0, 1.0]])
    rows = np.concatenate([np.hstack([good, flow, np.ones((2, 2))]), stray])
    median, along, down = script.biases(rows)
    assert median == pytest.approx(0.02) and along == pytest.approx(0.001)
    share = 1 / (1 + np.array([0.1, 0.2]) ** 2)
    assert down == pytest.approx(share[1] * 0.02 / share.sum())
