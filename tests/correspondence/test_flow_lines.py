"""Straight edges of a picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.slam.frame import Frame
from droidw_plugins.correspondence._flow import FlowCorrespondence
from droidw_plugins.correspondence._flow_lines import line_segments
from droidw_plugins.correspondence.flow import FlowOptions

CORNERS = np.array([[60, 40], [250, 70], [230, 190], [40, 160]])


def board(softness=0.8):
    """A bright four-cornered plate before a dark wall, [240,320] uint8."""
    picture = np.full((960, 1280), 60, np.uint8)
    cv2.fillConvexPoly(picture, 4 * CORNERS + 2, 180)
    picture = cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(picture, (0, 0), softness)


def distance(points, a, b):
    """Of points [n,2] from the line through a and b."""
    way = (b - a) / np.linalg.norm(b - a)
    return np.abs((points - a) @ np.array([-way[1], way[0]]))


def test_edges_of_a_plate_are_found_to_a_fifth_of_a_pixel():
    found = line_segments(board())
    ends = found.reshape(-1, 2, 2)
    assert len(found) >= 4
    for a, b in zip(CORNERS, np.roll(CORNERS, -1, axis=0), strict=True):
        off = np.array([distance(pair, a, b).max() for pair in ends])
        length = np.linalg.norm(ends[off < 1, 0] - ends[off < 1, 1], axis=1).sum()
        assert length > 0.8 * np.linalg.norm(b - a)
        # The direction is what counts: of both ends from a line as steep as the edge.
        for pair in ends[off < 1]:
            assert distance(pair[1:], pair[0], pair[0] + (b - a))[0] < 0.4


def half_plane(normal, away, height=120, width=160, finer=8):
    """Bright beyond a line at a distance from the middle, [height,width] uint8, middle, [2]."""
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    y, x = np.mgrid[: height * finer, : width * finer]
    x, y = (x + 0.5) / finer - 0.5 - middle[0], (y + 0.5) / finer - 0.5 - middle[1]
    fine = np.where(normal[0] * x + normal[1] * y > away, 200.0, 60.0)
    picture = fine.reshape(height, finer, width, finer).mean(axis=(1, 3))
    return cv2.GaussianBlur(picture, (0, 0), 0.6).round().astype(np.uint8), middle


@pytest.mark.parametrize(("noise", "shifted", "turned"), [(0, 0.01, 0.03), (10, 0.02, 0.1)])
def test_lines_lie_where_the_edges_are(noise, shifted, turned):
    # OpenCV's detector, as it is, says all of them an eighth of a pixel up and to the left, and
    # under noise an end off by 0.14 pixels against the other.
    draw = np.random.default_rng(0)
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False) + 0.05
    off, tilt, across = [], [], []
    for number, normal in enumerate(np.stack([np.cos(turns), np.sin(turns)], axis=1)):
        away = 1.7 * number - 20
        picture, middle = half_plane(normal, away)
        noisy = picture + draw.normal(0, noise, picture.shape)
        for line in line_segments(noisy.clip(0, 255).round().astype(np.uint8)).reshape(-1, 2, 2):
            if np.linalg.norm(line[1] - line[0]) > 30:
                one, other = (line - middle) @ normal - away
                off.append((one + other) / 2)
                tilt.append(other - one)
                across.append(normal)
    shift, *_ = np.linalg.lstsq(np.array(across), np.array(off), rcond=None)
    assert len(off) >= len(turns)
    assert np.abs(shift).max() < shifted
    assert np.sqrt(np.mean(np.square(tilt))) < turned


@pytest.mark.parametrize("picture", [np.full((60, 80), 90, np.uint8), np.eye(40, dtype=np.uint8)])
def test_what_has_no_edge_has_no_lines(picture):
    assert line_segments(picture).shape == (0, 4)


def test_short_edges_are_left_out():
    picture = np.full((60, 80), 60, np.uint8)
    picture[20:28, 30:38] = 180
    assert line_segments(picture).shape == (0, 4)


def test_the_operator_takes_the_picture_as_it_was_before_it_was_softened():
    picture = board(softness=0.6)
    image = torch.from_numpy(picture).float().div(255).expand(3, -1, -1).contiguous()
    part = FlowCorrespondence(FlowOptions(workers=1))
    frame = Frame(0, 0.0, image, torch.tensor([200.0, 200, 160, 120]))
    payload = part.encode(frame, Grid.of(240, 320, part.stride, part.offset))
    assert payload.unsoftened is not None
    assert np.array_equal(part.line_segments(payload), line_segments(payload.unsoftened))
