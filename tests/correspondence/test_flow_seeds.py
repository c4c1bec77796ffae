"""Points matched by descriptors, and searches that set out from them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw_plugins.correspondence._flow_seeds import (
    SeedBook,
    Seeds,
    _held,
    coherent,
    detect,
    drawn,
    matched,
    uncovered,
)
from droidw_plugins.correspondence._flow_types import FlowFrame

HEIGHT, WIDTH, STRIDE = 160, 208, 8
SHIFT = np.array([12, -7])


def marks(seed=0, count=60, blank=128.0):
    """Grey levels [H,W] of a wall with small marks, each unlike the others."""
    random = np.random.default_rng(seed)
    grey = np.full((HEIGHT, WIDTH), blank)
    for y, x in zip(
        random.integers(8, HEIGHT - 16, count), random.integers(8, WIDTH - 16, count), strict=True
    ):
        grey[y : y + 5, x : x + 5] = random.integers(0, 2, (5, 5)) * 120 + 60
    return grey


def moved(grey, shift=SHIFT):
    return np.roll(grey, shift, axis=(1, 0))


def picture(grey):
    return np.clip(cv2.GaussianBlur(grey, (0, 0), 0.7) + 0.5, 0, 255).astype(np.uint8)


def frame_of(index, grey):
    centres = np.zeros((HEIGHT // STRIDE, WIDTH // STRIDE, 2), np.float32)
    return FlowFrame(index, picture(grey), centres, centres, centres, centres, STRIDE)


def test_points_are_found_where_they_went():
    seeds = matched(detect(picture(marks()), 500), detect(picture(moved(marks())), 500))
    off = np.abs(seeds.there - seeds.here - SHIFT).max(axis=1)
    assert len(seeds) > 60
    assert (off < 0.3).mean() > 0.9
    kept = coherent(seeds)
    assert len(kept) > 0.7 * len(seeds)
    assert np.abs(kept.there - kept.here - SHIFT).max() < 2.5


def test_points_lie_in_the_middle_of_what_they_are():
    y, x = np.mgrid[:120, :160].astype(np.float32)
    middles = np.random.default_rng(0).uniform(0, 1, (24, 2)) + [
        (20 * k + 20, 20 * j + 20) for j in range(4) for k in range(6)
    ]
    spots = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / 12) for u, v in middles)
    found = detect((40 + 150 * spots).astype(np.uint8), 500).at
    off = np.stack([found[np.linalg.norm(found - m, axis=1).argmin()] - m for m in middles])
    near = off[np.linalg.norm(off, axis=1) < 1]
    assert len(near) > 16 and np.abs(np.median(near, axis=0)).max() < 0.04


def test_a_blank_picture_has_no_points_and_matches_nothing():
    blank, seen = detect(picture(marks(count=0)), 500), detect(picture(marks()), 500)
    assert len(blank.at) == 0
    for pair in ((blank, seen), (seen, blank), (blank, blank)):
        assert len(coherent(matched(*pair))) == 0


def test_a_corner_is_held_and_a_point_on_a_line_is_not():
    grey = np.full((HEIGHT, WIDTH), 90.0)
    grey[40:60, 30:50] = 180.0
    grey[100:, :] = 180.0  # an edge, with a bend of a pixel in it
    grey[100, 120:] = 90.0
    at = np.float32([[30, 40], [49, 59], [120, 100]])
    assert _held(picture(grey), at).tolist() == [True, True, False]
    found = detect(picture(marks()), 500)
    assert found.held.shape == (len(found.at),)
    assert found.held.mean() > 0.8


def test_a_pair_is_held_where_both_of_it_are():
    a, b = detect(picture(marks()), 500), detect(picture(moved(marks())), 500)
    whole = matched(replace(a, held=a.held & False), b)
    assert len(whole) > 60
    assert not whole.held.any()
    assert not matched(a, replace(b, held=b.held & False)).held.any()
    both = matched(replace(a, held=a.held | True), replace(b, held=b.held | True))
    assert both.held.all()
    assert np.array_equal(both.turned().held, both.held)
    some = both.where(np.arange(len(both)) < 5)
    assert len(some.held) == 5


def test_products_of_descriptors_are_exact():
    points = detect(picture(marks()), 500)
    wide = points.descriptor.astype(np.float64)
    exact = wide @ wide.T
    narrow = points.descriptor.astype(np.float32)
    assert exact.max() < 2**24  # whole numbers up to this are exact in float32
    assert np.array_equal(exact, narrow @ narrow.T)
    # and all are as long as each other, which `matched` relies on
    assert np.abs(np.diag(exact) / 255**2 - 1).max() < 0.03


def paired(here, there):
    return Seeds(here, there, np.ones(len(here), bool))


def field(count=30):
    random = np.random.default_rng(1)
    here = random.uniform(20, 140, (count, 2)).astype(np.float32)
    return paired(here, here + SHIFT.astype(np.float32))


def test_what_moves_unlike_all_around_it_is_left_out():
    seeds = field()
    there = seeds.there.copy()
    wrong = np.arange(len(seeds)) % 6 == 0
    there[wrong] += np.linspace(-90, 90, 2 * wrong.sum()).reshape(-1, 2) + 20
    kept = coherent(replace(seeds, there=there))
    assert np.array_equal(kept.here, seeds.here[~wrong])
    assert len(coherent(seeds.where(np.arange(len(seeds)) < 4))) == 0  # too few to tell


def test_one_corner_found_many_times_has_no_vote_for_itself():
    here = np.full((9, 2), 50, np.float32) + np.linspace(0, 1, 9, dtype=np.float32)[:, None]
    assert len(coherent(paired(here, here + 5))) == 0


def test_points_on_closed_cells_and_their_border_are_left_out():
    closed = np.zeros((20, 26), bool)
    closed[5, 7] = True  # x from 56 to 63, y from 40 to 47
    here = np.array([[57, 41], [54, 44], [65, 44], [52, 44], [59, 51]], np.float32)
    elsewhere = np.full_like(here, 150.0)
    expected = [[52, 44], [59, 51]]
    assert uncovered(paired(here, elsewhere), closed, None, STRIDE).here.tolist() == expected
    assert uncovered(paired(elsewhere, here), None, closed, STRIDE).there.tolist() == expected
    assert len(uncovered(paired(here, here), None, None, STRIDE)) == len(here)


def test_flow_is_drawn_to_seeds_near_it_and_stays_elsewhere():
    here = np.array([[60, 80], [64, 84]], np.float32)
    seeds = paired(here, here + np.float32([9, 3]))
    flow = np.full((HEIGHT, WIDTH, 2), (1.0, 0.0), np.float32)
    pulled, off = drawn(flow, seeds)
    assert off == pytest.approx([np.hypot(8, 3)] * 2, rel=1e-5)
    assert np.abs(pulled[82, 62] - (9, 3)).max() < 1.5
    assert np.array_equal(pulled[20, 180], flow[20, 180])
    assert np.array_equal(flow[82, 62], (1.0, 0.0))  # not in place


def test_what_is_kept_of_a_pair_does_not_depend_on_what_was_closed_first():
    a, b = frame_of(0, marks()), frame_of(1, moved(marks()))
    closed = np.zeros((HEIGHT // STRIDE, WIDTH // STRIDE), bool)
    closed[:, 8:] = True
    book, other = SeedBook(500), SeedBook(500)
    some, everything = book.between(a, b, here=closed), book.between(a, b)
    assert np.array_equal(everything.here, other.between(a, b).here)
    assert 0 < len(some) < len(everything)
    assert some.here[:, 0].max() < 64 - 1


@pytest.fixture(scope="module")
def found(operator, frame, question):
    """Displacement [h,w,2] px and confidence [h,w,3] of a wall that moved by a period of its lines.

    The prediction is that it has not moved, and all its lines agree with that.
    """

    def call(**options):
        x = np.mgrid[:HEIGHT, :WIDTH][1]
        lines = 128 + 50 * np.cos(2 * np.pi * x / 26)
        mark = marks(count=40) - 128
        pictures = [picture(lines + np.roll(mark, s, axis=1)) for s in (0, 26)]
        part = operator(**options)
        given = [frame(n, grey.astype(np.float64)) for n, grey in enumerate(pictures)]
        request = replace(question(part, given), informed=True)
        answer = part.session("window").update(request)
        return 8 * (answer.target[0] - request.coords[0]), answer.confidence[0]

    return call


def test_seeds_lead_out_of_a_wrong_prediction(found):
    right = []
    for seeds in (0, 1500):
        displacement, confidence = found(seeds=seeds, seeds_below=1.0)
        weight = confidence[..., :2].sum(-1)
        near = (displacement - torch.tensor([26.0, 0.0])).norm(dim=-1) < 1
        right.append(float((weight * near).sum() / weight.sum()))
    assert right[1] > right[0] + 0.15


@pytest.mark.parametrize(("below", "asked"), [(0.0, False), (0.2, True), (1.0, True)])
def test_points_are_asked_where_a_picture_says_little(found, below, asked):
    # Lines that go one way, and a few marks: two cells of three may slip.
    without, confidence = found(seeds=0)
    displacement, _ = found(seeds_below=below)
    assert torch.equal(displacement, without) is not asked
    assert float(confidence.sum()) > 0


def test_cells_are_held_by_structure_in_two_directions(operator, frame):
    x = np.mgrid[:HEIGHT, :WIDTH][1]
    lines = 128 + 50 * np.cos(2 * np.pi * x / 26)
    grid = Grid.of(HEIGHT, WIDTH, STRIDE, (STRIDE - 1) / 2)
    blank, lined, marked = (
        operator().encode(frame(n, grey), grid)
        for n, grey in enumerate((np.full((HEIGHT, WIDTH), 128.0), lines, marks(count=400)))
    )
    assert blank.held == lined.held == 0.0
    assert marked.held > 0.6
    half = np.zeros((grid.height, grid.width), bool)
    half[:, : grid.width // 2] = True
    assert replace(marked, bridged=half).held < 0.6 * marked.held


def test_seeds_of_one_run_are_those_of_the_next(found):
    one, other = found(seeds_below=1.0), found(seeds_below=1.0)
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_points_are_told_to_whom_asks_for_them(operator, frame):
    pictures = [picture(grey) for grey in (marks(), moved(marks()))]
    part, grid = operator(), Grid.of(HEIGHT, WIDTH, STRIDE, (STRIDE - 1) / 2)
    a, b = (part.encode(frame(n, p.astype(np.float64)), grid) for n, p in enumerate(pictures))
    gate = np.ones((grid.height, grid.width), np.float32)
    points = part.matched_points(a, b, gate, gate)
    assert len(points) > 40
    assert (np.abs(points[:, 2:] - points[:, :2] - SHIFT).max(axis=1) < 0.3).mean() > 0.9
    half = gate.copy()
    half[:, 8:] = 0.0
    left = part.matched_points(a, b, half, gate)
    assert 0 < len(left) < len(points)
    assert left[:, 0].max() < 64
    assert operator(seeds=0).matched_points(a, b, gate, gate).shape == (0, 4)
