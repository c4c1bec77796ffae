"""Global adjustment searches the second picture as it looks through what geometry predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from droidw.testing.scenes import Scene, SceneSpec


@pytest.fixture(scope="module")
def room():
    return Scene(SceneSpec(208, 160, 21, 30.0, 3, False, "orbit"))


@pytest.fixture(scope="module")
def pictures(frame, room):
    """The first and the last: what is seen at a slant has become wider or narrower."""
    grey = [room.render(k).image.astype(np.float32).mean(-1) for k in (0, 20)]
    return [frame(k, picture) for k, picture in enumerate(grey)]


@pytest.fixture(scope="module")
def measured(operator, question, pictures, room):
    """`measured(off, wrong, purpose, **options)`: targets, px, true ones, where they are known.

    Predicted is the truth, `off` pixels to the right, and a share `wrong` of it anywhere near.
    """

    def call(off=0.0, wrong=0.0, purpose="global", **options):
        part = operator(**options)
        asked = replace(question(part, pictures), informed=True)
        truth = room.correspond(0, 20, asked.payload(0).centres.astype(np.float64))
        there = np.nan_to_num(truth.target) + np.array([off, 0.0])
        rng = np.random.default_rng(0)
        strays = rng.uniform(size=there.shape[:2]) < wrong
        there[strays] += rng.uniform(-20.0, 20.0, (strays.sum(), 2))
        coords = (there - part.offset) / part.stride
        asked = replace(asked, coords=torch.from_numpy(coords.astype(np.float32))[None])
        found = part.session(purpose).update(asked)
        target = found.target[0].numpy() * part.stride + part.offset
        known = truth.visible & (found.confidence[0, ..., :2].numpy().min(-1) > 0.3)
        assert known.mean() > 0.3
        return target, truth.target, known

    return call


def error(targets):
    """Median distance from the truth, px."""
    target, truth, known = targets
    return float(np.median(np.linalg.norm(target - truth, axis=-1)[known]))


def test_matches_are_more_exact_than_from_a_start_alone(measured):
    assert error(measured()) < 0.7 * error(measured(warp=False))


def test_they_are_not_all_off_in_one_way(measured):
    target, truth, known = measured()
    off = target - truth
    near = known & (np.linalg.norm(off, axis=-1) < 0.5)
    assert np.linalg.norm(off[near].mean(axis=0)) < 0.02


def test_the_picture_that_is_seen_through_it_is_not_displaced(operator):
    part = operator()
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(160, 208)) * np.exp(-np.square(spectrum(160, 208) / 0.12))
    for off in (0.2, 0.8):
        a, b = (shifted(waves, moved) for moved in (0.0, 5 + off))
        expected = np.full((160, 208, 2), [5 + off, 0.0], np.float32)
        found = part._dense.warped(a, b, expected, fine=True)[30:-30, 30:-30]
        assert abs(float(np.median(found[..., 0])) - 5 - off) < 0.015


def spectrum(height, width):
    """Frequencies [H,W] of a Fourier transform, in cycles per pixel."""
    return np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width))


def shifted(waves, moved):
    """A picture with this spectrum, moved to the right, exactly."""
    turned = waves * np.exp(-2j * np.pi * np.fft.fftfreq(waves.shape[1]) * moved)
    picture = np.fft.ifft2(turned).real
    return np.clip(128 + 40 * picture / picture.std(), 0, 255).round().astype(np.uint8)


def test_cells_of_a_wrong_depth_tear_nothing(measured):
    whole, torn = measured(), measured(wrong=0.1)
    assert torn[2].sum() > 0.9 * whole[2].sum()
    assert error(torn) < 1.3 * error(whole)


def test_a_wrong_prediction_is_not_confirmed(measured):
    """Nor was it by patches that set out from it: what they kept must not come back."""
    right, _, known = measured()
    wrong, _, also = measured(off=1.0)
    moved = float(np.median((wrong - right)[known & also][:, 0]))
    assert abs(moved) < 0.05  # of the pixel by which it was off


def test_the_window_sets_out_as_it_did(measured):
    both = [measured(purpose="window", warp=warp)[0] for warp in (True, False)]
    assert np.array_equal(*both)
