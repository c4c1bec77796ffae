"""What `flow` makes of a camera that changes its exposure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from droidw.geometry.camera import Grid
from droidw_plugins.correspondence._flow_exposure import as_bright, brightened
from droidw_plugins.correspondence._flow_types import FlowFrame

HEIGHT, WIDTH = 120, 160
INNER = (slice(3, -3), slice(3, -3))


@pytest.fixture(scope="module")
def scene():
    """Grey levels [H,W+40] of a picture with structure at every size, 70 to 170."""
    rng = np.random.default_rng(3)
    levels = sum(
        cv2.resize(rng.normal(size=(n, n)).astype(np.float32), (WIDTH + 40, HEIGHT), None, 0, 0, 2)
        for n in (6, 12, 24, 48)
    )
    return np.clip(120 + 14 * levels, 70, 170)


def seen(scene, shift, gain=1.0):
    """The picture [H,W] of a camera that has moved so many pixels to the right."""
    return np.rint(scene[:, shift : shift + WIDTH] * gain).astype(np.uint8)


def frame_of(grey, index=0):
    y, x = np.mgrid[4:HEIGHT:8, 4:WIDTH:8].astype(np.float32)
    blank = np.zeros((*x.shape, 2), np.float32)
    return FlowFrame(index, grey, blank, blank, blank, np.stack([x, y], -1), 8)


@pytest.mark.parametrize("gain", [0.6, 0.8, 0.95, 1.05, 1.25, 1.45])
@pytest.mark.parametrize("off", [0, 3])
def test_the_change_of_brightness_is_found_wherever_cells_about_went(scene, gain, off):
    first, second = frame_of(seen(scene, 10)), frame_of(seen(scene, 16, gain))
    moved = np.full((*first.centres.shape[:2], 2), (-6.0 + off, 0.0), np.float32)
    assert np.log(brightened(first, second, moved)) == pytest.approx(np.log(gain), abs=0.03)


def test_half_a_hundredth_is_no_change(scene):
    first, second = frame_of(seen(scene, 10)), frame_of(seen(scene, 10, 1.003))
    assert brightened(first, second, None) == 1.0
    assert as_bright(second.grey, 1.0) is second.grey


def test_what_moves_has_no_say_while_it_is_the_smaller_part(scene):
    first, second = seen(scene, 10), seen(scene, 10, 1.2)
    second[:, : int(0.4 * WIDTH)] = 200
    assert brightened(frame_of(first), frame_of(second), None) == pytest.approx(1.2, abs=0.03)


@pytest.mark.parametrize("gain", [1.0, 0.9, 1.15])
def test_what_is_covered_does_not_sway_what_is_left(scene, gain):
    """Things that are brighter, each in its way, cover two fifths: the median is off by far."""
    rng = np.random.default_rng(5)
    brighter = rng.uniform(1.02, 1.4, scene.shape)
    brighter[:, 10 + int(0.4 * WIDTH) :] = 1.0
    brighter *= rng.normal(1.0, 0.02, scene.shape)
    first, second = frame_of(seen(scene, 10)), frame_of(seen(scene * brighter, 10, gain))
    assert np.median(second.grey / first.grey) > 1.01 * gain
    found = brightened(first, second, None)
    assert found == pytest.approx(gain, abs=0.008)
    assert found == 1.0 or gain != 1.0


@pytest.mark.parametrize(("level", "known"), [(0, 1.0), (255, 1.0), (240, 2.0)])
def test_black_and_white_say_nothing_and_twice_is_the_most(scene, level, known):
    first = frame_of(np.full((HEIGHT, WIDTH), 60, np.uint8))
    second = frame_of(np.full((HEIGHT, WIDTH), level, np.uint8))
    assert brightened(first, second, None) == pytest.approx(known)


def test_a_picture_is_put_back_to_its_brightness(scene):
    off = as_bright(seen(scene, 0, 1.3), 1.3).astype(float) - seen(scene, 0)
    assert np.abs(off).max() <= 1


@pytest.mark.parametrize("gain", [0.75, 1.3])
def test_matches_are_exact_and_count_as_much_as_without_the_change(
    scene, gain, operator, frame, question
):
    def errors(gain, **options):
        part = operator(**options)
        pictures = seen(scene, 10), seen(scene, 16, gain)
        request = question(part, [frame(n, p.astype(np.float32)) for n, p in enumerate(pictures)])
        answer = part.session("window").update(request)
        moved = 8 * (answer.target[0] - request.coords[0]).numpy()[INNER]
        off = np.hypot(moved[..., 0] + 6.0, moved[..., 1])
        return float(np.median(off)), float(answer.confidence[0][INNER].mean())

    plain, count = errors(1.0)
    steady, steady_count = errors(gain)
    swayed, _ = errors(gain, exposure=False)
    assert plain < steady < 0.02  # grey levels are rounded twice
    assert steady < 0.5 * swayed
    assert steady_count == pytest.approx(count, rel=0.01)


def test_a_flash_is_no_blank_picture(scene, operator, frame):
    """The motion filter goes on: nothing is lost because all of it is brighter."""
    first, second = (frame(n, seen(scene, 10 + 4 * n, 1 + 0.3 * n)) for n in range(2))
    motions = []
    for exposure in (True, False):
        part = operator(exposure=exposure)
        grid = Grid.of(HEIGHT, WIDTH, part.stride, part.offset)
        a, b = (part.encode(f, grid) for f in (first, second))
        motions.append(part.motion(a, b))
    assert motions[0].matched > 0.8 > motions[1].matched
    assert 8 * motions[0].flow == pytest.approx(4.0, abs=0.1)
