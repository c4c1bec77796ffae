"""Reader `dycheck`: pictures of the moving camera, COLMAP's poses, the principal point of haru."""

from __future__ import annotations

import numpy as np
import pytest

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw_plugins.datasets._colmap import read_poses
from droidw_plugins.datasets.dycheck import COMPONENT, DycheckOptions


@pytest.fixture
def reader():
    return COMPONENT.factory(DycheckOptions(), None)


def test_pictures_times_and_truth(reader, trees, data):
    trees.dycheck(data / "DyCheck" / "apple")
    source = reader.open("dycheck:apple", Selection())
    frames = list(source.frames())
    assert [f.name for f in frames] == [f"0_{n:05d}.png" for n in (0, 1, 2, 4, 5)]
    # the gap in the numbers is a gap in time
    np.testing.assert_allclose([f.time * 30 for f in frames], [0, 1, 2, 4, 5])
    np.testing.assert_allclose(source.truth.times, [f.time for f in frames])
    # 2 m per number along x, in units of the way from first to last
    np.testing.assert_allclose(source.truth.centres[:, 0], [0, 0.2, 0.4, 0.8, 1.0], atol=1e-12)
    np.testing.assert_allclose(source.truth.centres[:, 1:], 0, atol=1e-12)
    # the camera is turned by +90 degrees world to camera, so by -90 camera to world
    np.testing.assert_allclose(source.truth.T_wc[:, 3:], [[0, 0, -(0.5**0.5), 0.5**0.5]] * 5)


def test_lengths_can_be_left_as_they_are(trees, tmp_path):
    reader = COMPONENT.factory(DycheckOptions(normalise=False, fps=10.0), None)
    folder = trees.dycheck(tmp_path / "scene")
    assert reader.recognises(str(folder))
    source = reader.open(str(folder), Selection())
    np.testing.assert_allclose(source.truth.centres[-1, 0], 10.0)
    assert source.truth.times[-1] == pytest.approx(0.5)
    assert source.camera is None


@pytest.mark.parametrize(
    ("scene", "published", "expected"),
    [
        ("apple", False, (735.619180, 735.619180, 360.0, 480.0)),
        ("haru-sit", False, (730.902832, 730.902832, 360.0, 480.0)),
        ("haru", True, (730.902832, 730.902832, 480.0, 360.0)),
        ("teddy", True, (765.106220, 765.106220, 360.0, 480.0)),
    ],
)
def test_cameras(context, trees, data, scene, published, expected):
    folder = {"haru": "haru-sit"}.get(scene, scene)
    trees.dycheck(data / "DyCheck" / folder, numbers=(0, 1), size=(720, 960))
    reader = COMPONENT.factory(DycheckOptions(), context(published))
    source = reader.open(f"dycheck:{scene}", Selection())
    camera = source.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == expected
    assert (camera.width, camera.height) == (720, 960) and not camera.is_distorted
    assert any("principal point" in text for text in source.problems) == ("haru" in scene)


def test_pictures_that_lie_on_their_side_get_the_camera_turned(reader, trees, data):
    trees.dycheck(data / "DyCheck" / "haru-sit", numbers=(0, 1), size=(960, 720))
    camera = reader.open("dycheck:haru-sit", Selection()).camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (960, 720, 480.0, 360.0)


def test_poses_that_are_no_numbers_or_missing(reader, trees, data):
    folder = trees.dycheck(data / "DyCheck" / "spin")
    poses = {
        f"0_{n:05d}.png": ((1, 0, 0, 0), (np.nan if n == 1 else -float(n), 0, 0))
        for n in (0, 1, 2, 4)
    }
    poses["0_00002.png"] = ((0, 0, 0, 0), (0, 0, 0))
    trees.images_bin(folder / "dense" / "sparse" / "images.bin", poses)
    source = reader.open("dycheck:spin", Selection())
    np.testing.assert_allclose(source.truth.centres[:, 0], [0, 1])
    assert any("3 of 5 pictures have no pose" in text for text in source.problems)


def test_a_broken_reconstruction_costs_the_score_alone(reader, trees, data, tmp_path):
    folder = trees.dycheck(data / "DyCheck" / "block")
    path = folder / "dense" / "sparse" / "images.bin"
    whole = path.read_bytes()
    for data_left in (b"", whole[:30], whole[: len(whole) - 10], b"\xff" * 200):
        path.write_bytes(data_left)
        source = reader.open("dycheck:block", Selection())
        assert source.truth is None and len(list(source.frames())) == 5
        assert any("cut short" in text for text in source.problems)
    path.unlink()
    assert reader.open("dycheck:block", Selection()).truth is None
    with pytest.raises(InputError, match="cannot be read"):
        read_poses(tmp_path / "none.bin")


def test_what_is_missing_is_said(reader, data, tmp_path):
    with pytest.raises(InputError, match="is not on disk") as error:
        reader.open("dycheck:apple", Selection())
    assert "by hand from https://drive.google.com" in error.value.hint
    with pytest.raises(InputError, match="has no dense/images"):
        reader.open(str(tmp_path), Selection())
    (tmp_path / "dense" / "images").mkdir(parents=True)
    with pytest.raises(InputError, match="no picture of the moving camera"):
        reader.open(str(tmp_path), Selection())
