"""How much a picture moved, where what has the most structure moves with the camera."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from droidw.geometry.camera import Grid
from droidw.interfaces.correspondence import Motion
from droidw_plugins.correspondence._flow_motion import middles, picture_motion

HEIGHT, WIDTH = 160, 208


def test_every_tile_counts_once():
    values = np.arange(24, dtype=np.float32).reshape(4, 6)
    known = np.ones((4, 6), dtype=bool)
    assert middles(values, known, 2).tolist() == [4.0, 7.0, 16.0, 19.0]
    known[:2, 3:] = False  # nothing known in one of them, and one cell only is nothing
    known[0, 3] = True
    assert middles(values, known, 2).tolist() == [4.0, 16.0, 19.0]
    known[1:] = False
    known[0] = True
    known[0, 1:4] = False
    assert middles(values, known, 3).tolist() == [0.0, 4.0, 5.0]  # too few tiles


def test_no_tiles_are_all_cells_in_order():
    values = np.random.default_rng(4).random((5, 7), dtype=np.float32)
    known = values > 0.4
    assert np.array_equal(middles(values, known, 0), values[known])


def seen(operator, frame, wall: float, thing: float, tiles: int) -> float:
    return measured(operator, frame, wall, thing, tiles, lambda aside: None).flow


def measured(operator, frame, wall, thing, tiles, choose) -> Motion:
    """Motion of a bare wall with a few lines, and of a thing before it, cells of 8 pixels each.

    `choose` is given which cells show the thing, and says which are set aside; None: none.
    """
    grey = np.full((HEIGHT, WIDTH), 150.0, dtype=np.float32)
    for x in range(-20, WIDTH, 44):
        cv2.line(grey, (x, 0), (x + 20, HEIGHT), 100.0, 2)
    blocks = np.random.default_rng(2).uniform(0, 255, (20, 20)).astype(np.float32)
    grey[24:128, 56:152] = cv2.resize(blocks, (96, 104), interpolation=cv2.INTER_NEAREST)
    part = operator(motion_tiles=tiles)
    grid = Grid.of(HEIGHT, WIDTH, part.stride, part.offset)
    payload = part.encode(frame(0, grey), grid)
    moved = np.zeros((grid.height, grid.width, 2), dtype=np.float32)
    moved[..., 0] = wall * part.stride
    moved[3:16, 7:19, 0] = thing * part.stride
    agrees = np.ones(moved.shape[:2], dtype=np.float32)
    cells = np.zeros(moved.shape[:2], dtype=bool)
    cells[2:17, 6:20] = True
    aside = choose(cells)
    if aside is not None:
        payload = part.aside(payload, torch.from_numpy(aside))
    return picture_motion(moved, agrees, payload, part.options)


def test_what_moves_with_the_camera_hides_less_of_its_motion(operator, frame):
    assert seen(operator, frame, wall=1.0, thing=0.1, tiles=0) < 0.65
    assert seen(operator, frame, wall=1.0, thing=0.1, tiles=6) > 0.7


def test_before_a_camera_at_rest_most_of_the_picture_has_the_say(operator, frame):
    assert seen(operator, frame, wall=0.0, thing=1.0, tiles=6) == 0.0


def test_what_may_move_by_itself_does_not_count(operator, frame):
    whole = measured(operator, frame, 1.0, 0.1, 6, lambda cells: None)
    wall = measured(operator, frame, 1.0, 0.1, 6, lambda cells: cells)
    assert whole.flow < 0.9 and wall.flow == 1.0
    assert wall.matched < 0.6 * whole.matched  # as where the user's mask covers it
    none = measured(operator, frame, 1.0, 0.1, 6, lambda cells: cells & False)
    assert none == whole


def test_where_nearly_all_may_move_all_of_it_counts(operator, frame):
    whole = measured(operator, frame, 1.0, 0.1, 6, lambda cells: None)
    assert measured(operator, frame, 1.0, 0.1, 6, lambda cells: cells | True) == whole


def test_a_blank_picture_tells_no_motion(operator, frame):
    part = operator()
    grid = Grid.of(HEIGHT, WIDTH, part.stride, part.offset)
    blank = part.encode(frame(0, np.full((HEIGHT, WIDTH), 90.0, dtype=np.float32)), grid)
    moved = np.full((grid.height, grid.width, 2), 5.0, dtype=np.float32)
    assert picture_motion(moved, np.ones(moved.shape[:2]), blank, part.options) == Motion(0.0, 0.0)
