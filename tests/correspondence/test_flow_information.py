"""What `flow` says of matches on lines: sure across, silent along."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.geometry.projective import pixel_grid
from droidw.interfaces.correspondence import EdgeRequest
from droidw_plugins.correspondence import flow
from droidw_plugins.correspondence._flow_information import (
    framed,
    information,
    likeness,
    structure,
    trust,
    turned,
)
from droidw_plugins.correspondence._flow_types import FlowFrame

HEIGHT, WIDTH, STRIDE = 160, 208, 8
GRID = Grid.of(HEIGHT, WIDTH, STRIDE, (STRIDE - 1) / 2)
INNER = (slice(4, -4), slice(4, -4))
ANGLES = (0.0, 30.0, 45.0, 90.0, 120.0, 165.0)


def stripes(degrees, shift=(0.0, 0.0), periods=(23.0, 37.0, 71.0)):
    """Grey levels [H,W] of stripes whose normal has this angle against x, moved by `shift`."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    n = np.deg2rad(degrees)
    across = (x - shift[0]) * np.cos(n) + (y - shift[1]) * np.sin(n)
    waves = [35 * np.sin(2 * np.pi * across / p + p) for p in periods]
    return (128 + np.sum(waves, axis=0)).astype(np.float32)


def blobs(shift=(0.0, 0.0)):
    """Grey levels [H,W] that fix a match in every direction."""
    crossed = ((20, (21, 90)), (75, (26, 70)), (140, (31, 60)))
    return 128 + sum(stripes(degrees, shift, periods) - 128 for degrees, periods in crossed) / 2


@pytest.fixture(scope="module")
def measured(operator, frame, question):
    """Displacement [h,w,2] in cells and confidence [h,w,3] from the first picture to the second."""

    def call(first, second, purpose="window", **options):
        part = operator(**options)
        request = question(part, [frame(n, grey) for n, grey in enumerate((first, second))])
        answer = part.session(purpose).update(request)
        return answer.target[0] - request.coords[0], answer.confidence[0].double()

    return call


def along(confidence, degrees):
    """n^T W n, [h,w], for a direction."""
    x, y = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    xx, yy, xy = confidence.unbind(-1)
    return xx * x * x + yy * y * y + 2 * xy * x * y


def is_information(confidence):
    xx, yy, xy = confidence.unbind(-1)
    return bool((xx >= 0).all() and (yy >= 0).all() and (xy**2 <= xx * yy + 1e-6).all())


@pytest.mark.parametrize("purpose", ["window", "fill"])
@pytest.mark.parametrize("degrees", ANGLES)
def test_a_line_is_known_across_and_not_along(degrees, purpose, measured):
    n = np.deg2rad(degrees)
    moved = 2 * np.array([np.cos(n), np.sin(n)]) + 1.5 * np.array([-np.sin(n), np.cos(n)])
    # lines without a mark and without an end: nothing keeps a match from slipping far
    apart, confidence = measured(stripes(degrees), stripes(degrees, moved), purpose, slide=100.0)
    assert confidence.shape == (GRID.height, GRID.width, 3)
    assert is_information(confidence)
    across, silent = along(confidence, degrees)[INNER], along(confidence, degrees + 90)[INNER]
    assert float(across.median()) > 0.7
    assert float(silent.max()) < 0.01
    # what is said across is true, whatever the match does along the line
    step = apart[..., 0] * np.cos(n) + apart[..., 1] * np.sin(n)
    assert float((step[INNER] * STRIDE - 2).abs().median()) < 0.5


def test_the_two_weights_alone_would_call_a_slanted_line_known_along_it(measured):
    _, confidence = measured(stripes(45), stripes(45, (2.0, 2.0)))
    two = torch.cat([confidence[..., :2], torch.zeros_like(confidence[..., :1])], dim=-1)
    assert float(along(two, 135)[INNER].median()) > 0.3
    assert float(along(confidence, 135)[INNER].median()) < 0.02


@pytest.mark.parametrize(("leak", "least"), [(0.0, 0.6), (0.1, 0.6)])
def test_a_picture_of_blobs_is_known_in_every_direction(measured, leak, least):
    _, confidence = measured(blobs(), blobs((2.0, 1.0)), edge_leak=leak)
    assert is_information(confidence)
    for degrees in ANGLES:
        assert float(along(confidence, degrees)[INNER].median()) > least


def test_a_blank_picture_says_nothing(measured):
    blank = np.full((HEIGHT, WIDTH), 90.0, dtype=np.float32)
    for purpose in ("window", "fill"):
        _, confidence = measured(blank, blank, purpose)
        assert float(confidence.abs().max()) < 1e-6


def test_without_texture_the_agreement_alone_counts(measured):
    blank = np.full((HEIGHT, WIDTH), 90.0, dtype=np.float32)
    _, confidence = measured(blank, blank, texture=0.0)
    assert torch.equal(confidence[INNER], torch.tensor([1.0, 1.0, 0.0]).expand(12, 18, 3).double())


def test_rounding_beside_texture_leaves_no_negative_power():
    blocks = np.random.default_rng(2).uniform(0, 255, (24, 32)).round().astype(np.float32)
    grey = cv2.resize(blocks, (320, 240), interpolation=cv2.INTER_NEAREST)
    grey = cv2.GaussianBlur(grey, (0, 0), 0.7)
    covered = np.zeros(grey.shape, dtype=bool)
    covered[60:200, 80:250] = True
    centres = Grid.of(240, 320, STRIDE, (STRIDE - 1) / 2).centres().numpy().astype(np.float32)
    _, power, _ = structure(grey, centres, STRIDE, covered)
    assert power.min() == 0.0


@pytest.mark.parametrize("degrees", ANGLES)
def test_the_normal_is_the_direction_of_the_gradient(degrees):
    centres = GRID.centres().numpy().astype(np.float32)
    texture, power, normal = structure(stripes(degrees), centres, STRIDE)
    n = np.deg2rad(degrees)
    sine = normal[..., 0] * np.sin(n) - normal[..., 1] * np.cos(n)
    assert np.abs(sine[INNER]).max() < 0.02
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=1e-6)
    assert (power[..., 0] >= power[..., 1]).all() and (power[..., 1] >= 0).all()
    assert (power[INNER][..., 1] < 0.01 * power[INNER][..., 0]).all()
    # the root of sum((35 2 pi / period)^2) / 2
    assert np.sqrt(power[INNER][..., 0].mean()) == pytest.approx(8.3, rel=0.1)
    assert texture.dtype == power.dtype == normal.dtype == np.float32


@pytest.mark.parametrize("degrees", ANGLES)
def test_a_line_has_no_bend_where_it_leaves_the_picture(degrees):
    centres = GRID.centres().numpy().astype(np.float32)
    grey = cv2.GaussianBlur(stripes(degrees), (0, 0), 0.7, borderType=cv2.BORDER_REPLICATE)
    _, power, _ = structure(grey, centres, STRIDE)
    assert (power[..., 1] < 0.01 * power[..., 0]).all()
    assert power[..., 0].min() > 0.1 * power[INNER][..., 0].min()


def test_a_match_may_slip_along_an_edge_but_not_off_it():
    options = flow.COMPONENT.options()
    normal = np.array([0.6, 0.8], dtype=np.float32)
    tangent = np.array([-0.8, 0.6], dtype=np.float32)
    errors = {"none": (0, 0), "slip": (0, 5), "off": (0, 7), "across": (0.5, 0), "far": (3.5, 0)}
    apart = np.stack([across * normal + slip * tangent for across, slip in errors.values()])
    first, second = trust(apart, np.tile(normal, (len(errors), 1)), options)
    half = 0.5
    assert dict(zip(errors, first, strict=True)) == pytest.approx(
        {"none": 1, "slip": 1, "off": 0, "across": half, "far": 0}, abs=1e-5
    )
    assert dict(zip(errors, second, strict=True)) == pytest.approx(
        {"none": 1, "slip": 0, "off": 0, "across": half, "far": 0}, abs=1e-5
    )


def test_matches_beside_the_border_of_either_picture_count_less():
    frame = some_frame(20)
    moved = np.zeros_like(frame.centres)
    moved[3, 4] = -frame.centres[3, 4] + 4.0  # to the corner
    moved[4, 4] = [WIDTH, 0]  # out of the picture
    share = framed(frame, moved, 5.0)
    less = np.ones_like(share, dtype=bool)
    less[1:-1, 1:-1] = False
    less[3, 4] = less[4, 4] = True
    np.testing.assert_array_equal(share, np.where(less, np.float32(0.25), np.float32(1)))
    assert share.dtype == np.float32
    assert (framed(frame, np.zeros_like(moved), 0.0) == 1).all()


@pytest.mark.parametrize(("border", "share"), [(5.0, 0.25), (0.0, 1.0)])
def test_a_border_makes_no_match_worth_nothing(border, share, measured):
    picture = stripes(20) + stripes(110)
    _, counts = measured(picture, picture, border=border)
    _, whole = measured(picture, picture, border=0.0)
    torch.testing.assert_close(counts[0], share * whole[0])
    torch.testing.assert_close(counts[5, 5], whole[5, 5])


def strong_direction(confidence):
    """Angle [h,w] in degrees, in [-90, 90), in which most is known."""
    xx, yy, xy = confidence.unbind(-1)
    return torch.rad2deg(0.5 * torch.atan2(xy, (xx - yy) / 2))


@pytest.mark.parametrize("roll", [-6.0, 6.0])
@pytest.mark.parametrize(("reach", "follows"), [(8, 1.0), (0, 0.0)])
def test_a_line_that_turns_is_known_across_as_it_then_runs(reach, follows, roll, measured):
    axis = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    before, after = (stripes(20 + angle, axis, (24.0,)) for angle in (0, roll))
    _, confidence = measured(before, after, turn_reach=reach, slide=100.0)
    middle = (slice(6, -6), slice(8, -8))
    sure = along(confidence, 20 + roll)[middle] > 0.5
    assert float(sure.double().mean()) > 0.8
    found = strong_direction(confidence)[middle][sure]
    # a picture of stripes alone lets flow slip without end, by much and not evenly
    assert float(found.median()) == pytest.approx(20 + follows * roll, abs=1.0)


def pulled(matrix):
    """A flow [H,W,2] that maps the picture by this matrix about its middle."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    at = np.stack([x - (WIDTH - 1) / 2, y - (HEIGHT - 1) / 2], -1)
    return (at @ (np.asarray(matrix) - np.eye(2)).T).astype(np.float32)


def some_frame(degrees):
    return frame_of(stripes(degrees))


def frame_of(grey):
    centres = GRID.centres().numpy().astype(np.float32)
    return FlowFrame(0, grey.astype(np.uint8), *structure(grey, centres, STRIDE), centres, STRIDE)


@pytest.mark.parametrize("degrees", ANGLES)
def test_the_normal_goes_with_the_flow_however_it_slips(degrees):
    """A normal is a covector: it goes with the inverse transpose of what the points go with."""
    payload = some_frame(degrees)
    matrix = np.array([[1.1, -0.2], [0.15, 0.9]])
    line = np.array([-payload.normal[..., 1], payload.normal[..., 0]])
    expected = np.einsum("ij,hwj->hwi", np.linalg.inv(matrix).T, payload.normal)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    slipped = pulled(matrix) + 3 * (matrix @ line[:, 10, 13]).astype(np.float32)
    for flow_there in (pulled(matrix), slipped):
        found = turned(payload, flow_there, 8)[INNER]
        cosine = np.abs((found * expected[INNER]).sum(-1))
        np.testing.assert_allclose(cosine, 1.0, atol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, rtol=1e-5)


@pytest.mark.parametrize("times", [0.4, 2.5])
def test_what_is_no_longer_like_the_line_keeps_its_normal(times):
    payload = some_frame(30)
    collapsed = pulled(np.zeros((2, 2)))  # all points of the line go to one
    for flow_there in (pulled(times * np.eye(2)), collapsed):
        assert np.array_equal(turned(payload, flow_there, 8)[INNER], payload.normal[INNER])
    assert np.array_equal(
        turned(payload, pulled([[0, -1], [1, 0]]), 8)[INNER], payload.normal[INNER]
    )
    assert turned(payload, pulled([[1, 0.2], [0, 1]]), 0) is payload.normal


PIXELS = pixel_grid(HEIGHT, WIDTH).numpy()


def alike(first, second, flow_there, error=0.7):
    """Median of what `likeness` says inside the picture."""
    there = np.broadcast_to(np.float32(flow_there), PIXELS.shape)
    found = likeness(frame_of(first), frame_of(second), there, PIXELS, error)
    assert found.dtype == np.float32 and (found >= 0).all() and (found <= 1).all()
    return float(np.median(found[INNER]))


@pytest.mark.parametrize("error", [0.7, 1.5])
@pytest.mark.parametrize("degrees", ANGLES)
def test_a_match_is_alike_by_less_the_further_it_is_off_across_a_line(degrees, error):
    # so narrow that no difference is common to the whole window
    before, after = (stripes(degrees, shift, (11.0, 13.0)) for shift in ((0.0, 0.0), (2.0, 1.0)))
    n = np.deg2rad(degrees)
    across, along_it = np.array([np.cos(n), np.sin(n)]), np.array([-np.sin(n), np.cos(n)])
    right = np.array([2.0, 1.0])
    assert alike(before, after, right, error) == 1.0
    assert alike(before, after, right + 5 * along_it, error) == 1.0
    assert alike(before, after, right + 0.95 * across, error) == 1.0
    half = np.hypot(1.0, error)
    assert alike(before, after, right + half * across, error) == pytest.approx(0.5, abs=0.1)
    assert alike(before, after, right + 2.5 * half * across, error) < 0.25


def test_a_brighter_picture_and_a_blank_one_are_alike():
    assert alike(blobs(), blobs() + 20, (0.0, 0.0)) > 0.98
    blank = np.full((HEIGHT, WIDTH), 90.0, dtype=np.float32)
    assert alike(blank, blank, (7.0, -3.0)) == 1.0


def test_what_does_not_look_alike_is_not_trusted(measured):
    """Two pictures without anything in common: some matches come back by chance."""
    other = blobs()[::-1, ::-1].copy()
    trusting, strict = (
        float(measured(blobs(), other, likeness=s)[1][..., :2].mean()) for s in (0.0, 0.7)
    )
    assert trusting > 0.1
    assert strict < 0.5 * trusting


def test_information_is_the_sum_of_both_directions():
    g = np.random.default_rng(3)
    shape = (5, 6)
    angle = g.uniform(0, 2 * np.pi, shape)
    power = np.sort(g.uniform(0, 40, (*shape, 2)), axis=-1)[..., ::-1].astype(np.float32)
    normal = np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)
    blank = np.zeros(shape, np.uint8)
    payload = FlowFrame(0, blank, power, power, normal, power, STRIDE)
    trusted = g.uniform(0, 1, (2, *shape)).astype(np.float32)
    options = flow.COMPONENT.options(texture=2.0, edge_leak=0.5)
    found = information(payload, *trusted, options)
    share = trusted * np.moveaxis(power / (power + 4), -1, 0)
    ratio = power[..., 1] / power[..., 0]
    share[1] *= ratio**2 / (ratio**2 + 0.5**2)
    n, t = normal[..., None], np.stack([-normal[..., 1], normal[..., 0]], -1)[..., None]
    expected = share[0][..., None, None] * n * np.swapaxes(n, -1, -2)
    expected = expected + share[1][..., None, None] * t * np.swapaxes(t, -1, -2)
    for k, (a, b) in enumerate(((0, 0), (1, 1), (0, 1))):
        np.testing.assert_allclose(found[..., k], expected[..., a, b], atol=1e-6)
    assert found.dtype == np.float32
    assert is_information(torch.from_numpy(found).double())


def test_a_bent_line_is_hardly_known_along_itself(measured):
    """An arc seen through one cell has some power along itself, and still lets a match slip."""
    rows, cols = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    radius = np.hypot(rows + 20, cols - WIDTH / 2)
    arcs = (128 + 60 * np.sin(2 * np.pi * radius / 24)).astype(np.float32)
    below = (slice(4, -4), slice(WIDTH // STRIDE // 2 - 1, WIDTH // STRIDE // 2 + 1))
    trusting, strict = (
        along(measured(arcs, arcs, edge_leak=leak)[1], 0)[below] for leak in (0.0, 0.1)
    )
    assert float(trusting.mean()) > 0.05
    assert float(strict.mean()) < 0.2 * float(trusting.mean())


def test_no_edges_have_three_channels_too(operator):
    part = operator()
    none = torch.zeros(0, GRID.height, GRID.width, 2)
    request = EdgeRequest([], [], [], none, none[..., 0] > 0, [].__getitem__)
    answer = part.session().update(request)
    assert answer.target.shape == none.shape
    assert answer.confidence.shape == (0, GRID.height, GRID.width, 3)
