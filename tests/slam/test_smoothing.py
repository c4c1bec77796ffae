"""Frames between keyframes are drawn to a steady motion, and keyframes stay."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.geometry import se3
from droidw.slam.smoothing import smoothed

COUNT, EVERY = 120, 5
HELD = np.arange(COUNT) % EVERY == 0
TIMES = np.arange(COUNT) / 20.0


def hand(times, seed=0):
    """A camera in a hand, world to camera: slow sways of some centimetres and degrees."""
    rng = np.random.default_rng(seed)
    path = np.zeros((len(times), 6))
    for _ in range(4):
        rate, phase = rng.uniform(0.5, 6.0, 6), rng.uniform(0, 6, 6)
        path += 0.02 / rate * np.sin(rate * times[:, None] + phase)
    path[:, 0] += 0.3 * times
    return se3.exp(torch.from_numpy(path))


def located(true, held=HELD, off=2e-4, seed=1):
    """The same, where each frame that is no keyframe is off by itself."""
    noise = off * torch.randn(len(true), 6, generator=torch.manual_seed(seed), dtype=torch.float64)
    noise[torch.from_numpy(held)] = 0.0
    return se3.mul(se3.exp(noise), true)


def off(T, true):
    """Distances of centres, and angles, [N] each."""
    apart = se3.mul(se3.inv(T), true)
    return apart[:, :3].norm(dim=1), se3.log(apart)[:, 3:].norm(dim=1)


@pytest.mark.parametrize(
    "times", [TIMES, np.cumsum(np.random.default_rng(2).uniform(0.04, 0.06, COUNT))]
)
def test_what_each_frame_is_off_by_itself_is_halved(times):
    true = hand(times)
    T = located(true)
    found = smoothed(T, list(times), HELD)
    for before, after in zip(off(T, true), off(found, true), strict=True):
        assert float(after.square().mean()) < 0.5**2 * float(before.square().mean())
    assert torch.equal(found[HELD], T[HELD])
    assert torch.allclose(found[:, 3:].norm(dim=1), torch.ones(COUNT).double())


def test_an_exact_path_stays_as_exact():
    true = hand(TIMES)
    found = smoothed(true, list(TIMES), HELD)
    assert max(float(part.max()) for part in off(found, true)) < 2e-5


@pytest.mark.parametrize("seed", range(4))
def test_a_frame_that_went_astray_is_brought_back(seed):
    true = hand(TIMES, seed)
    T, frame = located(true), 51 + seed
    T[frame, :3] += torch.tensor([0.01, -0.02, 0.005])
    place, _ = off(smoothed(T, list(TIMES), HELD), true)
    assert float(place[frame]) < 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_stops_at_once_stops(seed):
    true, frame = hand(TIMES, seed), 61 + seed
    true[frame:] = true[frame]
    place, _ = off(smoothed(located(true), list(TIMES), HELD), true)
    assert float(place[frame - 5 : frame + 8].max()) < 1e-3


def test_nothing_is_drawn_across_a_gap():
    """The camera is elsewhere after a second in which nothing was seen."""
    true, times = hand(TIMES), TIMES.copy()
    times[60:] += 1.0
    true[60:, 0] += 2.0
    T = located(true)
    place, _ = off(smoothed(T, list(times), HELD), true)
    before, _ = off(T, true)
    assert float(place[56:64].max()) < 2.0 * float(before.max())


@pytest.mark.parametrize(
    ("times", "held"),
    [
        (TIMES, np.ones(COUNT, bool)),
        (TIMES[:12], HELD[:12]),
        (np.append(TIMES[:-1], TIMES[-2]), HELD),
        (np.cumsum(np.tile([0.05, 0.2], COUNT // 2)), HELD),
    ],
)
def test_where_too_little_is_known_a_path_stays_as_it_is(times, held):
    T = located(hand(TIMES))[: len(times)]
    assert torch.equal(smoothed(T, list(times), held), T)
