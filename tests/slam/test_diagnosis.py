"""What a user is told of motion that cannot give much."""

from __future__ import annotations

import numpy as np
import torch

from droidw.geometry import se3
from droidw.geometry.camera import Grid
from droidw.graph.store import KeyframeInfo, KeyframeStore
from droidw.slam.diagnosis import MIN_PARALLAX, Diagnosis, parallax

H, W = 24, 32
K = torch.tensor([208.0, 208.0, 127.5, 95.5])
TURN = torch.tensor([0.0, 0.0, 0.0, 0.004, 0.03, 0.002])
SHIFT = torch.tensor([0.04, 0.01, 0.0, 0.0, 0.0, 0.0])


def store_of(step, disps, count=5):
    """Keyframes of a camera that makes the same step again and again; disps [h,w] in all."""
    store = KeyframeStore(Grid(H, W, 8, 3.5), K)
    for n in range(count):
        info = KeyframeInfo(n, n / 30, str(n), np.zeros((H * 8, W * 8, 3), np.uint8), None)
        store.append(info, T_cw=se3.exp(n * step), disps=disps)
    return store


def relief(spread, seed=0):
    """Disparities [h,w] around 0.5."""
    return 0.5 * (1 + spread * (2 * torch.rand(H, W, generator=torch.manual_seed(seed)) - 1))


ALL = torch.ones(5, H, W)


def test_turning_is_not_parallax():
    assert parallax(store_of(TURN, relief(0.6)), ALL) < 1e-3
    # some translation that the depth, nearly a plane, makes look like turning
    assert parallax(store_of(TURN + 0.1 * SHIFT, relief(0.1)), ALL) < MIN_PARALLAX


def test_shifting_is_parallax_however_small_the_steps():
    for factor in (0.1, 1.0):
        assert parallax(store_of(factor * SHIFT, relief(0.6)), ALL) > 2 * MIN_PARALLAX
        both = factor * (SHIFT + 0.3 * TURN)
        assert parallax(store_of(both, relief(0.6)), ALL) > 2 * MIN_PARALLAX


def test_what_moves_by_itself_is_no_parallax():
    """Depth of a fifth of the picture was bent until it fitted something that moves."""
    disps = relief(0.1)
    disps[6:18, 4:16] = 8.0
    store = store_of(TURN + 0.03 * SHIFT, disps)
    assert parallax(store, ALL) < MIN_PARALLAX
    weight = ALL.clone()
    weight[:, 6:18, 4:16] = 0
    assert parallax(store, weight) <= parallax(store, ALL)


def test_parallax_of_nothing():
    assert np.isnan(parallax(store_of(SHIFT, relief(0.1), count=1), ALL[:1]))
    assert np.isnan(parallax(store_of(SHIFT, relief(0.1)), 0 * ALL))


def told(**facts):
    """All warnings as one text."""
    given = {"frames": 60, "keyframes": 9, "still": False, "lost": 0.0, "parallax": 0.3,
             "points": 900, **facts}  # fmt: skip
    return " ".join(Diagnosis(**given).warnings())


def test_warnings():
    assert told() == ""
    assert "almost no parallax (only 2.0% of the flow" in told(parallax=0.02, points=0)
    text = told(keyframes=2, points=0)
    assert "only 2 of 60 frames became keyframes" in text and "the cloud is empty" in text
    assert "motion_filter.threshold" in text
    assert "the cloud is empty" not in told(keyframes=2, points=3)
    assert "the point cloud is empty: no static cell has a depth" in told(points=0)
    assert told(points=None) == ""
    assert "the camera did not move" in told(keyframes=1, still=True, points=0)
