"""Pictures: natural order, decoding to RGB, and what is cut short or no picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from droidw.errors import InputError
from droidw.io.images import list_images, read_image


def picture(path, colour=(200, 30, 60), size=(64, 48)):
    image = np.full((size[1], size[0], 3), colour, np.uint8)
    image[::7, ::5] = 255
    cv2.imwrite(str(path), image[..., ::-1])
    return image


def test_natural_order_and_only_pictures(tmp_path):
    for name in ("f10.png", "f9.png", "F2.PNG", "f1.jpg", ".hidden.png", "notes.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in list_images(tmp_path)] == ["f1.jpg", "F2.PNG", "f9.png", "f10.png"]


def test_a_folder_that_cannot_be_listed(tmp_path):
    with pytest.raises(InputError, match="cannot be listed"):
        list_images(tmp_path / "missing")


def test_pictures_are_rgb_whatever_they_were(tmp_path):
    image = picture(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), image)
    cv2.imwrite(str(tmp_path / "g.png"), image[..., 0])
    np.testing.assert_array_equal(read_image(tmp_path / "g.png")[..., 2], image[..., 0])
    cv2.imwrite(str(tmp_path / "d.png"), image[..., ::-1].astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_image(tmp_path / "d.png"), image)


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_cut_files_are_refused(tmp_path, name, share):
    path: Path = tmp_path / name
    picture(path)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(InputError, match="cut short"):
        read_image(path)


def test_a_jpeg_with_something_behind_its_end_is_whole(tmp_path):
    picture(tmp_path / "a.jpg")
    whole = read_image(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.jpg").read_bytes() + b"film" * 50_000)
    np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), whole)


@pytest.mark.parametrize(
    ("content", "words"), [(b"", "empty"), (b"no picture at all", "cannot be decoded")]
)
def test_no_picture(tmp_path, content, words):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_image(tmp_path / "a.png")
    with pytest.raises(InputError, match="no such file"):
        read_image(tmp_path / "b.png")
