"""Masks of the user: which belongs to which picture, on which pixels and cells they lie."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch

from droidw.errors import InputError
from droidw.geometry.camera import Camera, Grid
from droidw.geometry.rectify import Rectifier
from droidw.io.masks import UserMasks
from droidw.slam.frame import RawFrame


def frame(index, name=""):
    return RawFrame(index, index / 30, np.zeros((48, 64, 3), np.uint8), name or f"{index:06d}")


@pytest.fixture
def folder(tmp_path):
    """Write masks: `folder({"a.png": 3})` marks the first 3 columns."""

    def write(masks, value=255, dtype=np.uint8):
        for name, columns in masks.items():
            picture = np.zeros((48, 64), dtype)
            picture[:, :columns] = value
            assert cv2.imwrite(str(tmp_path / name), picture)
        return tmp_path

    return write


def columns(mask):
    """How many columns are marked, from the left."""
    assert mask.dtype == bool and mask.shape == (48, 64)
    count = int(mask[0].sum())
    assert mask[:, :count].all() and not mask[:, count:].any()
    return count


def test_by_name_wins(folder):
    # In the order of their names the masks would belong to other pictures.
    masks = UserMasks(folder({"b.png": 2, "a.png": 1, "c.png": 3}), 3, 3)
    assert [columns(masks.of(frame(k, f"{name}.jpg"))) for k, name in enumerate("bca")] == [2, 3, 1]
    assert masks.problems() == []


def test_by_order_where_there_are_as_many(folder):
    masks = UserMasks(folder({"m1.png": 1, "m2.png": 2, "m3.png": 3}), 3, 3)
    assert [columns(masks.of(frame(k))) for k in (0, 2)] == [1, 3]
    # Every second of five or six pictures was chosen, so that there may be five or six masks.
    several = folder({f"m{k}.png": k for k in range(1, 7)})
    assert columns(UserMasks(several, 5, 6).of(frame(4))) == 5


def test_the_order_is_that_of_pictures(folder):
    """Nobody pads numbers with zeros: 10 comes after 9, as it does among pictures."""
    masks = UserMasks(folder({f"{k}.png": k for k in range(1, 13)}), 12, 12)
    found = [columns(masks.of(frame(k, f"frame{k + 1}.jpg"))) for k in range(12)]
    assert found == list(range(1, 13))


def test_hidden_files_are_no_masks(folder):
    place = folder({"m1.png": 1, "m2.png": 2})
    (place / "._m1.png").write_bytes(b"of a file manager")
    masks = UserMasks(place, 2, 2)
    assert [columns(masks.of(frame(k))) for k in range(2)] == [1, 2]


def test_by_number_some_may_be_missing(folder):
    masks = UserMasks(folder({"000002.png": 2, "000005.png": 5}), 9, 9)
    assert masks.of(frame(0, "x.jpg")) is None
    assert columns(masks.of(frame(5, "y.jpg"))) == 5
    assert masks.of(frame(0, "x.jpg")) is None  # a second pass counts no picture twice
    (told,) = masks.problems()
    assert told.startswith("1 of 2 pictures have no mask in ")


def test_by_time_if_names_are_seconds(folder):
    masks = UserMasks(folder({"0.002.png": 3, "0.069.png": 5}), 5, 5)
    assert columns(masks.of(frame(0, "a"))) == 3
    assert masks.of(frame(1, "b")) is None  # 0.033 s
    assert columns(masks.of(frame(2, "c"))) == 5
    assert "1 of 3 pictures have no mask" in masks.problems()[0]
    # Of another time: they are no masks of these pictures.
    with pytest.raises(InputError, match="its 2 masks cannot be laid on 5 pictures"):
        UserMasks(folder({}), 5, 5).of(frame(60, "a"))


def test_masks_that_droidw_wrote_go_by_number(folder):
    place = folder({"000001.png": 1, "000002.png": 2})
    (place / "scale.json").write_text(json.dumps({"named": "index"}))
    # The pictures happen to be counted from 1.
    assert columns(UserMasks(place, 2, 2).of(frame(1, "000002.png"))) == 1


def test_whatever_is_not_black_is_ignored(folder):
    assert columns(UserMasks(folder({"a.png": 4}, value=1)).of(frame(0, "a"))) == 4
    # 16 bits, of which 8 would be 0.
    dim = folder({"b.png": 7}, value=3, dtype=np.uint16)
    assert columns(UserMasks(dim).of(frame(0, "b"))) == 7
    colour = np.zeros((48, 64, 3), np.uint8)
    colour[:, :9, 0] = 10
    cv2.imwrite(str(dim / "c.png"), colour)
    assert columns(UserMasks(dim).of(frame(0, "c"))) == 9


def test_what_does_not_fit_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match="there is no such folder"):
        UserMasks(tmp_path / "nothing")
    with pytest.raises(InputError, match="holds no masks"):
        UserMasks(tmp_path)
    with pytest.raises(
        InputError, match="its 2 masks cannot be laid on 5 pictures: none is called"
    ):
        UserMasks(folder({"a.png": 1, "b.png": 2}), 5, 5).of(frame(0))
    (tmp_path / "000000.png").write_text("no picture")
    with pytest.raises(InputError, match=r"000000\.png: cannot be read as a picture"):
        UserMasks(tmp_path).of(frame(0))


CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def test_any_size_is_laid_on_the_picture_without_blending():
    rectify = Rectifier(CAMERA, long_side=64)
    mask = np.zeros((48, 64), bool)
    mask[10:30, 21:45] = True
    assert np.array_equal(rectify.rectify_mask(mask), mask)
    large = np.kron(mask, np.ones((3, 3), bool))
    assert np.array_equal(rectify.rectify_mask(large), mask)
    small = mask[::2, ::2]
    assert np.array_equal(rectify.rectify_mask(small), np.kron(small, np.ones((2, 2), bool)))
    for shape in ((48, 48), (64, 48)):
        with pytest.raises(InputError, match="does not fit pictures of 64x48"):
            rectify.rectify_mask(np.zeros(shape, bool))
        with pytest.raises(InputError, match=r"a mask of .* \(picture g.jpg\) does not fit"):
            rectify(frame(7, "g.jpg"), np.zeros(shape, bool))


@pytest.mark.parametrize(
    "camera",
    [
        Camera(128, 102, 110.0, 112.0, 60.0, 52.0),
        Camera(128, 102, 110.0, 112.0, 60.0, 52.0, (-0.3, 0.1, 0.001, 0.0), "opencv"),
    ],
    ids=["pinhole", "distorted"],
)
def test_a_mask_goes_the_way_of_its_picture(camera):
    """Undistorted, resized, cropped: mask and picture of the same blob still cover each other."""
    rectify = Rectifier(camera, long_side=96, edge=2)
    picture = np.zeros((102, 128, 3), np.uint8)
    cv2.circle(picture, (80, 45), 22, (255, 255, 255), -1)
    done = rectify(RawFrame(0, 0.0, picture, ""), picture[..., 0] > 0)
    assert done.mask.shape == done.image.shape[1:]
    seen = done.image[0] > 0.5
    differ = (done.mask != seen).sum().item()
    assert seen.sum() > 500 and differ <= 0.05 * seen.sum()
    # A mask at working size is one already.
    assert torch.equal(torch.from_numpy(rectify.rectify_mask(done.mask.numpy())), done.mask)
    assert rectify(RawFrame(0, 0.0, picture, "")).mask is None


def test_a_mask_of_a_raw_picture_is_undistorted_though_nothing_is_resized():
    """Both have 128x96 pixels: which of them a mask shows, only who wrote it tells."""
    camera = Camera(128, 96, 110.0, 112.0, 63.0, 48.0, (-0.35, 0.12, 0.0, 0.0), "opencv")
    rectify = Rectifier(camera, long_side=128)
    picture = np.zeros((96, 128, 3), np.uint8)
    cv2.circle(picture, (24, 22), 14, (255, 255, 255), -1)
    done = rectify(RawFrame(0, 0.0, picture, ""), picture[..., 0] > 0)
    seen = done.image[0] > 0.5
    assert (done.mask != seen).sum() <= 0.05 * seen.sum()
    working = done.mask.numpy()
    assert (working != (picture[..., 0] > 0)).sum() > 0.2 * working.sum()
    assert np.array_equal(rectify.rectify_mask(working, working=True), working)
    larger = np.kron(working, np.ones((2, 2), bool))  # of a run at another size
    assert np.array_equal(rectify.rectify_mask(larger, working=True), working)
    with pytest.raises(InputError, match="does not fit pictures of 128x96"):
        rectify.rectify_mask(working.T, working=True)


@pytest.mark.parametrize("long_side", [320, 512, 640])
@pytest.mark.parametrize("of", [320, 512, 640])
def test_masks_of_a_run_at_another_size(long_side, of):
    """320x180 is cropped to 320x176, 512x288 is not: what they show lies at the same place."""
    camera = Camera(1920, 1080, 1500.0, 1500.0, 959.5, 539.5)
    raw = np.zeros((1080, 1920), bool)
    raw[300:800, 500:1500] = True
    expected = Rectifier(camera, long_side=long_side).rectify_mask(raw)
    made = Rectifier(camera, long_side=of).rectify_mask(raw)
    laid = Rectifier(camera, long_side=long_side).rectify_mask(made, working=True)
    assert laid.shape == expected.shape
    assert (laid != expected).sum() <= 0.04 * expected.sum()


def test_masks_that_droidw_wrote_show_its_working_pictures(folder):
    place = folder({"000000.png": 3})
    assert not UserMasks(place).working
    (place / "scale.json").write_text(json.dumps({"named": "index"}))
    assert UserMasks(place).working


@pytest.mark.parametrize(("stride", "offset"), [(8, 3.5), (8, 0.0), (4, 1.5), (1, 0.0), (5, 2.0)])
def test_share_of_a_cell(stride, offset):
    height, width = 43, 57
    grid = Grid.of(height, width, stride, offset)
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(3)) < 0.4
    share = grid.covered(mask)
    assert share.shape == (grid.height, grid.width)
    for y in range(grid.height):
        for x in range(grid.width):
            # The pixels around the centre of the cell, border pixels repeated.
            start = [int(np.ceil(stride * k + offset - stride / 2)) for k in (y, x)]
            rows = [min(max(start[0] + k, 0), height - 1) for k in range(stride)]
            across = [min(max(start[1] + k, 0), width - 1) for k in range(stride)]
            expected = mask[rows][:, across].float().mean()
            assert share[y, x] == pytest.approx(expected.item(), abs=1e-6)
    assert grid.covered(torch.ones(height, width, dtype=torch.bool)).eq(1).all()
