"""Reader `bonn`: by name and by folder, true poses moved to the camera, and the traps."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.errors import InputError
from droidw.geometry import se3
from droidw.interfaces.datasets import FrameSource, Selection
from droidw.slam.frame import Trajectory
from droidw_plugins.datasets._bonn import corrected
from droidw_plugins.datasets.bonn import COMPONENT, BonnOptions


@pytest.fixture
def reader():
    return COMPONENT.factory(BonnOptions(), None)


@pytest.fixture
def balloon(trees, data):
    return trees.rgbd(data / "Bonn" / "rgbd_bonn_balloon", size=(640, 480))


def test_by_name(reader, balloon, trees):
    assert reader.recognises("bonn:balloon")
    source = reader.open("bonn:balloon", Selection(max_frames=4))
    assert isinstance(source, FrameSource)
    frames = list(source.frames())
    np.testing.assert_allclose(
        [f.time for f in frames], trees.START + np.arange(4) / 30, atol=1e-4, rtol=0
    )
    assert source.name == "bonn-balloon"
    camera = source.camera
    assert (camera.fx, camera.fy) == (542.822841, 542.576870)
    assert (camera.cx, camera.cy) == (315.593520, 237.756098)
    assert camera.distortion == (0.039903, -0.099343, -0.000730, -0.000144, 0.0)
    assert len(source.truth) == 6 and np.isfinite(source.truth.T_wc).all()


def test_by_folder_and_by_its_other_name(reader, balloon, trees, data):
    assert reader.recognises(str(balloon))
    assert reader.open(str(balloon), Selection()).camera.fx == 542.822841
    trees.rgbd(data / "Bonn" / "rgbd_bonn_person_tracking", count=2)
    assert reader.open("bonn:person", Selection()).name == "bonn-person_tracking"


def test_a_sequence_on_disk_needs_no_row(reader, trees, data):
    trees.rgbd(data / "Bonn" / "rgbd_bonn_synchronous", count=2, size=(640, 480))
    assert reader.open("bonn:synchronous", Selection()).camera.fx == 542.822841


def test_the_pose_correction():
    """Against the product of matrices written out, and a pose worked out by hand."""
    ros = np.array([[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    marker = np.array(
        [[1.0157, 0.1828, -0.2389, 0.0113], [0.0009, -0.8431, -0.6413, -0.0098],
         [-0.3009, 0.6147, -0.8085, 0.0111], [0, 0, 0, 1]]
    )  # fmt: skip
    generator = torch.Generator().manual_seed(0)
    poses = se3.exp(torch.randn(5, 6, generator=generator, dtype=torch.float64))
    found = corrected(Trajectory(np.arange(5.0), poses.numpy()))
    for pose, moved in zip(poses, found.T_wc, strict=True):
        wanted = ros.T @ se3.matrix(pose).numpy() @ ros @ marker
        np.testing.assert_allclose(moved[:3], wanted[:3, 3], atol=1e-12)
        turned = se3.rotation(torch.from_numpy(moved)).numpy()
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turned) > 0
        # the published matrix is no rotation by up to 5 %, so no more than that can agree
        assert np.abs(turned - wanted[:3, :3]).max() < 0.06
    still = corrected(Trajectory(np.zeros(1), np.array([[1.0, 2, 3, 0, 0, 0, 1]])))
    # axes of ROS to those of the camera: x' = -x, y' = z, z' = y; then the marker's offset
    np.testing.assert_allclose(still.centres[0], [-1 + 0.0113, 3 - 0.0098, 2 + 0.0111])


def test_it_needs_neither_depth_nor_truth(reader, trees, data):
    folder = trees.rgbd(data / "Bonn" / "rgbd_bonn_crowd", depth=False)
    (folder / "groundtruth.txt").unlink()
    source = reader.open("bonn:crowd", Selection())
    assert source.truth is None and len(list(source.frames())) == 6


def test_gaps_repeats_and_poses_that_are_no_numbers(reader, trees, data):
    folder = trees.rgbd(data / "Bonn" / "rgbd_bonn_crowd2", count=8)
    names = sorted((folder / "rgb").iterdir())
    names[3].unlink()
    rows = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join([*rows[:4], rows[3], *rows[4:]]) + "\n")
    truth = (folder / "groundtruth.txt").read_text().splitlines()
    truth[5] = truth[5].split()[0] + " nan nan nan nan nan nan nan"
    truth[9] = truth[8]
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    source = reader.open("bonn:crowd2", Selection())
    frames = list(source.frames())
    assert len(frames) == 7 and source.skipped == 2
    assert np.diff([f.time for f in frames]).min() > 0
    assert np.isfinite(source.truth.T_wc).all() and np.diff(source.truth.times).min() > 0
    said = "\n".join(source.problems)
    assert "repeats" in said and "nan" in said and names[3].name in said


def test_published_pictures_under_compat(context, trees, data):
    """Those with depth and truth within 0.08 s, at most 60 a second, counted anew."""
    folder = trees.rgbd(data / "Bonn" / "rgbd_bonn_moving_nonobstructing_box", count=12, rate=100)
    (folder / "depth.txt").write_text(f"{trees.START + 0.005} depth/a.png\n")
    published = COMPONENT.factory(BonnOptions(), context(published=True))
    frames = list(published.open("bonn:moving", Selection()).frames())
    # 100 a second: every second one is 1/60 s after the last; beyond 85 ms there is no depth
    np.testing.assert_allclose(
        [f.time - trees.START for f in frames], [0, 0.02, 0.04, 0.06, 0.08], atol=1e-5
    )
    assert [f.index for f in frames] == [0, 1, 2, 3, 4]
    plain = COMPONENT.factory(BonnOptions(), context())
    assert len(list(plain.open("bonn:moving", Selection()).frames())) == 12
    (folder / "depth.txt").unlink()
    source = published.open("bonn:moving", Selection())
    assert source.length == 6 and any("no depth.txt" in text for text in source.problems)
    (folder / "depth.txt").write_text("1.0 depth/a.png\n")
    with pytest.raises(InputError, match="no picture has a depth map and a true pose"):
        published.open("bonn:moving", Selection())


def test_what_is_not_there_says_what_to_type(reader, data, context):
    with pytest.raises(InputError, match="bonn:balloon2 is not on disk") as error:
        reader.open("bonn:balloon2", Selection())
    assert "droidw data fetch bonn:balloon2" in error.value.hint
    assert str(data) in error.value.message and "DROIDW_DATA" in error.value.hint
    with pytest.raises(InputError, match="has no sequence 'baloon'") as error:
        reader.open("bonn:baloon", Selection())
    assert "did you mean 'bonn:balloon'" in error.value.hint and "crowd2" in error.value.hint
    with pytest.raises(InputError, match="which sequence"):
        reader.open("bonn:", Selection())
    elsewhere = COMPONENT.factory(BonnOptions(), context(data_dir=data / "elsewhere"))
    with pytest.raises(InputError, match="elsewhere"):
        elsewhere.open("bonn:balloon", Selection())


def test_others_are_left_alone(reader, trees, tmp_path):
    plain = trees.rgbd(tmp_path / "rgbd_dataset_freiburg3_walking_xyz", count=1)
    for source in (str(plain), "tum:x", "http://bonn", "", "bonn"):
        assert not reader.recognises(source)
    with pytest.raises(ValueError, match="max_difference"):
        BonnOptions(max_difference=0.0)
