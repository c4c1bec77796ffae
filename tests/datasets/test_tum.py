"""Reader `tum`: the benchmark's own layout, its cameras, and true poses by nearest time."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from droidw.errors import InputError
from droidw.interfaces.datasets import FrameSource, Selection
from droidw_plugins.datasets.tum import COMPONENT, TumOptions

START = 1341846434.0


@pytest.fixture
def reader():
    return COMPONENT.factory(TumOptions(), None)


def sequence(tmp_path, name="rgbd_dataset_freiburg1_desk", size=(640, 480), count=4):
    folder = tmp_path / name
    (folder / "rgb").mkdir(parents=True)
    rows = ["# color images", "# file: 'desk.bag'", "# timestamp filename"]
    for i in range(count):
        stamp = f"{START + i / 30:.6f}"
        cv2.imwrite(str(folder / "rgb" / f"{stamp}.png"), np.zeros((*size[::-1], 3), np.uint8))
        rows.append(f"{stamp} rgb/{stamp}.png")
    (folder / "rgb.txt").write_text("\n".join(rows) + "\n")
    (folder / "depth.txt").write_text("# depth maps\n")
    truth = ["# ground truth trajectory", "# file: 'desk.bag'", "# timestamp tx ty tz qx qy qz qw"]
    truth += [f"{START - 0.5 + k / 100:.4f} {k / 100} 0 0 0 0 0 1" for k in range(57)]
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    return folder


def test_pictures_camera_and_true_poses(reader, tmp_path):
    folder = sequence(tmp_path)
    assert reader.recognises(str(folder))
    source = reader.open(str(folder), Selection())
    assert isinstance(source, FrameSource)
    frames = list(source.frames())
    np.testing.assert_allclose([f.time for f in frames], START + np.arange(4) / 30, atol=1e-6)
    assert (source.camera.fx, source.camera.cy) == (517.3, 255.3)
    assert source.camera.model == "opencv"
    assert len(source.camera.distortion) == 5
    assert any("published calibration of freiburg1" in problem for problem in source.problems)
    # rows lie 10 ms apart and end 60 ms after the first picture
    np.testing.assert_allclose(source.truth.times - START, [0.0, 0.03, 0.06], atol=1e-4)
    np.testing.assert_allclose(source.truth.centres[:, 0], [0.5, 0.53, 0.56])
    assert any("1 of 4 pictures have no true pose" in problem for problem in source.problems)


@pytest.mark.parametrize(
    ("name", "focal", "distorted"),
    [("rgbd_dataset_freiburg2_xyz", 520.9, True), ("fr3_walking", 535.4, False)],
)
def test_the_camera_goes_by_the_name(reader, tmp_path, name, focal, distorted):
    source = reader.open(str(sequence(tmp_path, name, count=1)), Selection())
    assert source.camera.fx == focal
    assert source.camera.is_distorted == distorted


def test_an_unknown_camera_is_said_to_be(reader, tmp_path):
    source = reader.open(str(sequence(tmp_path, "office", count=1)), Selection())
    assert source.camera is None
    assert "does not say which camera" in source.problems[0]
    small = sequence(tmp_path, "freiburg1_small", size=(320, 240), count=1)
    assert reader.open(str(small), Selection()).camera is None


def test_it_leaves_other_folders_to_others(reader, tmp_path):
    folder = sequence(tmp_path, count=1)
    (folder / "camera.txt").write_text("fx 1\n")
    assert not reader.recognises(str(folder))
    assert not reader.recognises(str(tmp_path))
    with pytest.raises(InputError, match=r"has no rgb\.txt"):
        reader.open(str(tmp_path), Selection())
    with pytest.raises(InputError, match="no such folder"):
        reader.open(str(tmp_path / "missing"), Selection())


def test_it_runs_without_truth(reader, tmp_path):
    folder = sequence(tmp_path, count=2)
    (folder / "groundtruth.txt").unlink()
    source = reader.open(str(folder), Selection())
    assert source.truth is None
    assert len(list(source.frames())) == 2


def test_by_name_and_its_short_form(reader, trees, data):
    trees.rgbd(data / "TUM_RGBD" / "rgbd_dataset_freiburg3_walking_xyz", size=(640, 480), count=2)
    for name in ("tum:freiburg3_walking_xyz", "tum:f3/wx"):
        assert reader.recognises(name)
        source = reader.open(name, Selection())
        assert source.camera.fx == 535.4 and source.name == "tum-freiburg3_walking_xyz"
    trees.rgbd(data / "TUM_RGBD" / "rgbd_dataset_freiburg1_desk", size=(640, 480), count=2)
    assert reader.open("tum:freiburg1_desk", Selection()).camera.fx == 517.3
    trees.rgbd(data / "walk", size=(640, 480), count=2)
    (data / "TUM_RGBD" / "rgbd_dataset_freiburg2_xyz").symlink_to(data / "walk")
    assert reader.open("tum:freiburg2_xyz", Selection()).camera.fx == 520.9
    with pytest.raises(InputError, match="has no sequence 'f3/w'"):
        reader.open("tum:f3/w", Selection())


def test_the_table_has_the_cameras_that_go_by_the_name():
    from droidw.io.dataset_tables import load_table
    from droidw_plugins.datasets._tum import _published_camera

    for row in load_table("tum").sequences.values():
        assert row.raw_camera() == _published_camera(row.name, (640, 480), [])


def test_published_pictures_under_compat(context, trees, data):
    trees.rgbd(data / "TUM_RGBD" / "rgbd_dataset_freiburg3_sitting_xyz", count=9, rate=100.0)
    published = COMPONENT.factory(TumOptions(), context(published=True))
    source = published.open("tum:freiburg3_sitting_xyz", Selection())
    times = [f.time - trees.START for f in source.frames()]
    np.testing.assert_allclose(times, np.arange(0, 9, 2) / 100, atol=2e-5)
