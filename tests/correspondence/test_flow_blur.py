"""Pictures may be softened before they are searched (`blur`)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw_plugins.correspondence._flow_mask import bridge, softened

HEIGHT, WIDTH = 160, 208
GRID = Grid.of(HEIGHT, WIDTH, 8, 3.5)
SHIFT = 3


def wall(shift=0, noise=3.0):
    """[H,W] faint marks that have moved to the right, under noise that has not."""
    marks = cv2.GaussianBlur(np.random.default_rng(7).normal(size=(HEIGHT, WIDTH)), (0, 0), 2.0)
    still = np.random.default_rng(8).normal(size=(HEIGHT, WIDTH))
    grey = 128 + 4 * np.roll(marks, shift, axis=1) / marks.std() + noise * still
    return grey.clip(0, 255).round()


@pytest.fixture
def error(operator, frame, question):
    """Mean distance of matches of such a wall from where its marks went, px, by confidence."""

    def call(**options):
        part = operator(**options)
        request = question(part, [frame(n, wall(n * SHIFT)) for n in range(2)])
        answer = part.session("global").update(request)
        moved = 8 * (answer.target - request.coords) - torch.tensor([float(SHIFT), 0.0])
        weight = answer.confidence[..., :2].sum(-1)
        return float((weight * moved.norm(dim=-1)).sum() / weight.sum())

    return call


def test_noise_that_stands_still_holds_less_of_a_wall_that_moves(error):
    assert error(blur=0.7) < 0.8 * error(blur=0.0)


@pytest.mark.parametrize("masked", [False, True])
def test_search_and_structure_see_the_softened_picture(operator, frame, masked):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[40:80, 60:120] = True
    given = frame(0, wall(), mask if masked else None)
    plain, soft = (operator(blur=b).encode(given, GRID) for b in (0.0, 0.7))
    assert np.array_equal(plain.grey, plain.sharp) and np.array_equal(soft.sharp, plain.sharp)
    inner = np.s_[8:-8, 8:-8]
    same = cv2.GaussianBlur(plain.sharp.astype(np.float32), (0, 0), 0.7)
    assert np.abs(soft.grey - same)[inner].max() < 1
    assert soft.power.mean() < plain.power.mean()
    covered = GRID.covered(torch.from_numpy(mask)).numpy() == 1
    assert (soft.power[covered] < 1e-3).all() == masked


def test_what_uncertainty_takes_out_leaves_nothing_beside_it(operator, frame):
    soft = operator(blur=2.0).encode(frame(0, wall(noise=0.0)), GRID)
    gate = np.ones((GRID.height, GRID.width), np.float32)
    gate[6:12, 8:16] = 0.1
    bridged = bridge(soft, gate, 0.5, 7, blur=2.0)
    inside = np.s_[52:92, 68:124]
    assert bridged.grey[inside].std() < 0.3 * soft.grey[inside].std()
    assert np.array_equal(bridged.grey[:30], soft.grey[:30])


def test_no_blur_is_the_picture_itself():
    grey = wall().astype(np.uint8)
    assert np.array_equal(softened(grey, 0.0), grey)
    level = np.full((9, 9), 77, np.uint8)
    assert np.allclose(softened(level, 1.5), 77, atol=1e-3)
