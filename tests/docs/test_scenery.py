"""benchmarks/scenery.py renders what its poses and masks say."""

import importlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from droidw.io.tum import read_tum


def white(rng, height, width):
    return np.full((height, width, 3), 250, np.float32)


def black(rng, height, width):
    return np.full((height, width, 3), 5, np.float32)


def ahead(world):
    """Towards a black wall a metre wide, five metres off; a white box drives by before it."""
    world.box(black, (1.0, 1.0, 0.1), (0.0, 5.05, 0.0))
    world.box(white, (0.2, 0.2, 0.2), lambda t: (0.4 - 0.8 * t, -0.5, 3.0, 0.0, 0.0, 0.0), actor=1)
    return lambda t: (0.0, -0.5, 2.0 * t, 0.0, 0.0, 0.0)


@pytest.fixture
def scenery(monkeypatch):
    """The script, which imports those beside it as scripts do."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return importlib.import_module("scenery")


@pytest.fixture
def clips(tmp_path, monkeypatch, scenery):
    """What is written for one small scene: the static folder and that with what moves."""
    made = scenery.Made(ahead, (96, 64), 10.0, 3, 1.0, {"moving": ()})
    monkeypatch.setattr(scenery, "SCENES", {"ahead": made})
    scenery.main([str(tmp_path), str(tmp_path / "out")])
    return tmp_path / "out" / "ahead", tmp_path / "out" / "ahead_moving"


def pictures(folder, name="rgb"):
    return [
        cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((folder / name).iterdir())
    ]


def test_the_wall_is_as_wide_as_poses_and_focal_length_say(clips):
    still, _ = clips
    fx = float((still / "camera.txt").read_text().split("fx ")[1].split()[0])
    shade = [float(picture[0].mean()) for picture in pictures(still)]
    assert min(shade) > 100  # the sky
    for picture, pose in zip(
        pictures(still), read_tum(still / "groundtruth.txt").T_wc, strict=True
    ):
        wide = (picture[32] < 100).sum()
        assert wide == pytest.approx(fx * 1.0 / (5.0 - pose[2]), abs=1.5)


def test_masks_show_what_drives_and_nothing_else_differs(clips):
    still, moving = clips
    assert not (still / "mask").exists()
    masks = pictures(moving, "mask")
    assert len(masks) == 3
    for before, after, mask in zip(pictures(still), pictures(moving), masks, strict=True):
        inside = cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0
        outside = cv2.dilate(mask, np.ones((3, 3), np.uint8)) == 0
        assert inside.any() and (after[inside] > 150).all()
        assert np.array_equal(after[outside], before[outside])
    middle = [np.flatnonzero(mask.any(axis=0)).mean() for mask in masks]
    assert middle[0] > middle[1] > middle[2]  # it drives to the left


def test_clearance_is_to_what_stands_still(scenery):
    made = scenery.Made(ahead, (96, 64), 10.0, 3, 1.0, {})
    assert scenery.Renderer(made, 0).clearance() == pytest.approx(3.0, abs=1e-3)  # not the box


def test_a_folder_that_is_there_is_left_alone(tmp_path, scenery):
    with pytest.raises(SystemExit, match="is there already"):
        scenery.main([str(tmp_path), str(tmp_path)])
