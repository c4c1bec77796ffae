"""Frames between keyframes are matched at half size, then made exact at full size."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from droidw_plugins.correspondence._flow_polish import polished

HEIGHT, WIDTH = 96, 128
SHIFT = np.array([2.3, -1.4], np.float32)


@pytest.fixture(scope="module")
def pair():
    """A soft random texture, and the same moved by `SHIFT`."""
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, WIDTH)), (0, 0), 1.5)
    picture = 128 + 4 * (picture - picture.mean())
    back = np.array([[1, 0, SHIFT[0]], [0, 1, SHIFT[1]]])
    moved = cv2.warpAffine(picture, back, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=4)
    return tuple(np.clip(np.rint(p), 0, 255).astype(np.uint8) for p in (picture, moved))


@pytest.fixture(scope="module")
def points():
    y, x = np.mgrid[19.5 : HEIGHT - 16 : 8, 19.5 : WIDTH - 16 : 8]
    return np.stack([x, y], -1).astype(np.float32)


def rough(points, by=0.4):
    """`SHIFT` at every point, off by up to `by` pixels each way."""
    off = np.random.default_rng(1).uniform(-by, by, points.shape)
    return (SHIFT + off).astype(np.float32)


def median_error(moved):
    return float(np.median(np.hypot(*np.moveaxis(moved - SHIFT, -1, 0))))


def test_matches_become_exact(pair, points):
    found = rough(points)
    kept = found.copy()

    better = polished(*pair, points, found, 9)

    assert better.shape == found.shape and better.dtype == np.float32
    assert median_error(found) > 0.2
    assert median_error(better) < 0.05
    assert np.array_equal(found, kept)


def test_another_exposure_does_not_move_edges(pair, points):
    a, b = pair
    darker = np.rint(0.8 * b.astype(np.float32) + 5).astype(np.uint8)

    assert median_error(polished(a, darker, points, rough(points), 9)) < 0.1


@pytest.mark.parametrize("window", [0, 2])
def test_no_window_leaves_what_was_found(pair, points, window):
    found = rough(points)

    assert polished(*pair, points, found, window) is found


def test_what_cannot_be_matched_stays_as_found(pair, points):
    found = rough(points)
    flat = np.full((HEIGHT, WIDTH), 90, np.uint8)
    outside = np.full_like(found, 500.0)

    assert np.allclose(polished(flat, flat, points, found, 9), found, atol=1e-4)
    assert np.allclose(polished(*pair, points, outside, 9), outside, atol=1e-4)


def test_nothing_moves_far_from_where_the_search_left_it(pair, points):
    astray = rough(points) + np.float32(6.0)

    assert np.abs(polished(*pair, points, astray, 9) - astray).max() < 1.5 + 1e-4


def test_frames_between_keyframes_are_matched_so(operator, question, frame, pair):
    pictures = [frame(k, p.astype(np.float32)) for k, p in enumerate(pair)]

    def error(**options):
        part = operator(**options)
        asked = replace(question(part, pictures), informed=True)
        found = part.session("fill").update(asked)
        moved = (found.target[0].numpy() - asked.coords[0].numpy()) * part.stride
        return median_error(moved[2:-2, 2:-2])

    assert error() < 0.5 * error(fill_window=0)
    assert error() < 0.05  # pixels
