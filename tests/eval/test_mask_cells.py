"""Masks of raw pictures go the way of the pictures: lens, size and crop."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from droidw.eval.masks import score_folder
from droidw.geometry.camera import Camera, Grid
from droidw.geometry.rectify import Rectification, Rectifier

RAW = Camera(
    640, 480, 500.0, 505.0, 322.0, 238.0, distortion=(-0.35, 0.12, 0.001, 0.0), model="opencv"
)
STRAIGHT = Camera(640, 480, 500.0, 505.0, 322.0, 238.0)
FISHEYE = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, (0.1, -0.02, 0.0, 0.0), "fisheye")


def blobs(seed: int) -> np.ndarray:
    """A mask [480,640] of a few discs, also at the borders, where lenses bend most."""
    rng = np.random.default_rng(seed)
    mask = np.zeros((480, 640), np.uint8)
    for _ in range(6):
        x, y, r = int(rng.integers(640)), int(rng.integers(480)), int(rng.integers(30, 80))
        cv2.circle(mask, (x, y), r, 255, -1)
    return mask


def written(root: Path, rectifier: Rectifier, stride: int = 8, offset: float = 3.5) -> Path:
    """A run folder whose uncertainty is what of each cell moves in the rectified picture."""
    for name in ("rgb", "mask", "uncertainty"):
        (root / name).mkdir(parents=True)
    width, height = rectifier.way.size
    grid = Grid.of(height, width, stride, offset)
    for number in range(4):
        mask = blobs(number)
        cv2.imwrite(str(root / "mask" / f"{number:06d}.png"), mask)
        cv2.imwrite(str(root / "rgb" / f"{number:06d}.png"), mask)
        moved = rectifier.rectify_image(np.repeat(mask[..., None], 3, axis=2))[..., 0]
        share = grid.covered(torch.from_numpy(moved / 255.0)).numpy()
        u = (60000 * share).round().astype(np.uint16)
        cv2.imwrite(str(root / "uncertainty" / f"{number:06d}.png"), u)
    facts = {
        "stride": stride,
        "offset": offset,
        "picture": [width, height],
        "rectified": rectifier.way.to_dict(),
    }
    (root / "uncertainty" / "scale.json").write_text(json.dumps(facts))
    return root


@pytest.mark.parametrize("camera", [STRAIGHT, RAW, FISHEYE], ids=["straight", "opencv", "fisheye"])
@pytest.mark.parametrize("edge", [0, 8])
def test_what_is_told_of_every_cell_scores_one(tmp_path: Path, camera: Camera, edge: int) -> None:
    root = written(tmp_path / "run", Rectifier(camera, long_side=320, edge=edge))
    found = score_folder(root / "uncertainty", root / "mask", source=root)
    assert found.auc is not None and found.auc > 0.9999
    assert found.iou is not None and found.iou > 0.99


def test_cells_that_do_not_part_the_picture_evenly(tmp_path: Path) -> None:
    root = written(tmp_path / "run", Rectifier(STRAIGHT, size=(300, 220)), stride=14, offset=6.5)
    found = score_folder(root / "uncertainty", root / "mask", source=root)
    assert found.auc is not None and found.auc > 0.9999


def test_masks_of_working_pictures_are_not_bent_again(tmp_path: Path) -> None:
    rectifier = Rectifier(RAW, long_side=320, edge=8)
    root = written(tmp_path / "run", rectifier)
    for path in sorted((root / "mask").iterdir()):
        raw = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0
        cv2.imwrite(str(path), np.where(rectifier.way.shares(raw) >= 0.5, 255, 0).astype(np.uint8))
    found = score_folder(root / "uncertainty", root / "mask", source=root)
    assert found.auc is not None and found.auc > 0.999


@pytest.mark.parametrize(
    "facts", ["{}", '{"rectified": {"raw": 3}}', '{"rectified": []}', "broken"]
)
def test_maps_of_others_are_taken_as_they_are(tmp_path: Path, facts: str) -> None:
    root = written(tmp_path / "run", Rectifier(STRAIGHT, long_side=320))
    before = score_folder(root / "uncertainty", root / "mask", source=root)
    (root / "uncertainty" / "scale.json").write_text(facts)
    after = score_folder(root / "uncertainty", root / "mask", source=root)
    assert after == before


def test_the_record_is_read_as_it_was_written() -> None:
    way = Rectifier(RAW, long_side=320, edge=4).way
    assert Rectification.from_dict(json.loads(json.dumps(way.to_dict()))) == way
    with pytest.raises(ValueError, match="impossible"):
        Rectification.from_dict({**way.to_dict(), "corner": [-1, 0]})
