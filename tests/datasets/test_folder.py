"""Reader `folder`: layouts, times, calibration, truth, and pictures that cannot be used."""

from __future__ import annotations

import threading

import cv2
import numpy as np
import pytest

from droidw.errors import InputError
from droidw.interfaces.datasets import DatasetReader, FrameSource, Selection
from droidw_plugins.datasets.folder import COMPONENT, FolderOptions

ALL = Selection()


def picture(path, i=0, size=(64, 48)):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((size[1], size[0], 3), (200, 10, (5 * i) % 256), np.uint8)
    image[::7, ::5] = 255
    cv2.imwrite(str(path), image[..., ::-1])


def listed(folder, times, size=(64, 48)):
    """A folder with rgb/ and rgb.txt, one picture per time."""
    for i in range(len(times)):
        picture(folder / "rgb" / f"{i:06d}.png", i, size)
    rows = [f"{time} rgb/{i:06d}.png" for i, time in enumerate(times)]
    (folder / "rgb.txt").write_text("# timestamp filename\n" + "\n".join(rows) + "\n")
    return folder


@pytest.fixture
def reader():
    return COMPONENT.factory(FolderOptions(), None)


def open_all(reader, folder, selection=ALL):
    source = reader.open(str(folder), selection)
    return source, list(source.frames())


def test_it_keeps_the_contract(reader, tmp_path):
    assert isinstance(reader, DatasetReader)
    source, frames = open_all(reader, listed(tmp_path, [0.0, 0.1, 0.25]))
    assert isinstance(source, FrameSource)
    assert source.length == 3
    assert source.name == tmp_path.name
    assert source.size == (64, 48)
    assert [f.index for f in frames] == [0, 1, 2]
    assert [f.time for f in frames] == [0.0, 0.1, 0.25]
    assert [f.name for f in frames] == ["000000.png", "000001.png", "000002.png"]
    assert frames[2].image[1, 1].tolist() == [200, 10, 10]
    assert (source.camera, source.truth, source.problems, source.skipped) == (None, None, [], 0)


def test_a_second_pass_gives_the_same_and_adds_no_problems(reader, tmp_path):
    listed(tmp_path, np.arange(6) / 10)
    (tmp_path / "rgb" / "000002.png").write_bytes(b"")
    source, first = open_all(reader, tmp_path)
    problems, skipped = list(source.problems), source.skipped
    assert (len(problems), skipped) == (1, 1)
    second = list(source.frames())
    assert [f.index for f in second] == [f.index for f in first] == [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(second[1].image, first[1].image)
    assert (source.problems, source.skipped) == (problems, skipped)


def test_selection(reader, tmp_path):
    listed(tmp_path, np.arange(20) / 10)
    source, frames = open_all(reader, tmp_path, Selection(stride=3, skip=2, max_frames=4))
    assert [f.index for f in frames] == [2, 5, 8, 11]
    assert source.length == 4
    with pytest.raises(InputError, match="leave none"):
        reader.open(str(tmp_path), Selection(skip=20))


@pytest.mark.parametrize("subfolder", ["", "rgb", "images"])
def test_pictures_without_times_get_thirty_a_second_and_it_is_said(reader, tmp_path, subfolder):
    for i in (10, 9, 1):
        picture(tmp_path / subfolder / f"frame{i}.jpg", i)
    assert reader.recognises(str(tmp_path))
    source, frames = open_all(reader, tmp_path)
    assert [f.name for f in frames] == ["frame1.jpg", "frame9.jpg", "frame10.jpg"]
    np.testing.assert_allclose([f.time for f in frames], [0, 1 / 30, 2 / 30])
    assert len(source.problems) == 1
    assert "30 a second assumed" in source.problems[0]
    assert source.skipped == 0


def test_the_frame_rate_is_an_option(tmp_path):
    for i in range(3):
        picture(tmp_path / f"{i}.png")
    _, frames = open_all(COMPONENT.factory(FolderOptions(fps=10.0), None), tmp_path)
    np.testing.assert_allclose([f.time for f in frames], [0, 0.1, 0.2])
    with pytest.raises(ValueError, match="fps"):
        FolderOptions(fps=0.0)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["1341846434.71", "1341846434.75", "1341846434.80"],
         [1341846434.71, 1341846434.75, 1341846434.80]),
        (["9.5", "10.0", "10.25"], [9.5, 10.0, 10.25]),
        (["000010", "000020", "000030"], [0, 1 / 30, 2 / 30]),
        (["1.0", "100.0", "2000.0"], [0, 1 / 30, 2 / 30]),
    ],
)  # fmt: skip
def test_names_are_times_only_if_they_look_like_seconds(reader, tmp_path, names, times):
    for name in names:
        picture(tmp_path / f"{name}.png")
    _, frames = open_all(reader, tmp_path)
    np.testing.assert_allclose([f.time for f in frames], times)


def test_camera_and_truth_are_read(reader, tmp_path):
    listed(tmp_path, [0.0, 0.1])
    (tmp_path / "camera.txt").write_text("width 128\nheight 96\nfx 100\nfy 100\ncx 63.5\ncy 47.5\n")
    (tmp_path / "groundtruth.txt").write_text("0 1 2 3 0 0 0 1\n0.1 nan 2 3 0 0 0 1\n0.2 1 2 3\n")
    source, _ = open_all(reader, tmp_path)
    assert (source.camera.width, source.camera.fx, source.camera.cx) == (64, 50.0, 31.5)
    assert source.truth.centres.tolist() == [[1, 2, 3]]
    assert len(source.problems) == 3
    assert "scaled" in source.problems[0]
    assert "line 2" in source.problems[1]


def test_truth_that_cannot_be_used_is_never_fatal(reader, tmp_path):
    listed(tmp_path, [0.0, 0.1])
    (tmp_path / "groundtruth.txt").write_text("no poses here\n")
    source, frames = open_all(reader, tmp_path)
    assert source.truth is None
    assert len(frames) == 2
    assert "not scored" in source.problems[-1]


def test_a_calibration_that_cannot_be_used_is(reader, tmp_path):
    listed(tmp_path, [0.0, 0.1])
    for line, words in (
        ("fx 50\nfy 50\ncx 90\ncy 24\n", "principal point"),
        ("fx nan\nfy 50\ncx 32\ncy 24\n", "fx is nan"),
        ("width 64\nheight 64\nfx 50\nfy 50\ncx 32\ncy 24\n", "another shape"),
    ):
        (tmp_path / "camera.txt").write_text(line)
        with pytest.raises(InputError, match=words):
            reader.open(str(tmp_path), ALL)


def test_unreadable_and_differently_sized_pictures_are_skipped_and_counted(reader, tmp_path):
    listed(tmp_path, np.arange(10) / 10)
    rgb = tmp_path / "rgb"
    (rgb / "000003.png").write_bytes(b"no picture")
    (rgb / "000004.png").unlink()
    (rgb / "000005.png").write_bytes((rgb / "000005.png").read_bytes()[:60])
    picture(rgb / "000006.png", size=(32, 24))
    source, frames = open_all(reader, tmp_path)
    assert [f.index for f in frames] == [0, 1, 2, 7, 8, 9]
    assert source.skipped == 4
    assert source.problems == [
        "000003.png: cannot be decoded, skipped",
        "000004.png: no such file, skipped",
        "000005.png: the file is cut short, skipped",
        "000006.png: 32x24 pixels where the others have 64x48, skipped",
    ]


def test_one_odd_picture_at_the_start_does_not_cost_the_rest(reader, tmp_path):
    listed(tmp_path, np.arange(8) / 10)
    picture(tmp_path / "rgb" / "000000.png", size=(32, 24))
    source, frames = open_all(reader, tmp_path)
    assert source.size == (64, 48)
    assert len(frames) == 7


@pytest.mark.parametrize(
    ("times", "kept"),
    [
        ([0, 0.1, 0.1, 0.2], [0, 1, 3]),
        ([0, 0.1, 0.05, 0.2], [0, 2, 3]),
        ([0, 0.1, 99, 0.2, 0.3], [0, 1, 3, 4]),
        ([5, 0, 0.1, 0.2], [1, 2, 3]),
        ([1, 1, 1], [0]),
    ],
)
def test_times_that_repeat_or_run_backwards(reader, tmp_path, times, kept):
    source, frames = open_all(reader, listed(tmp_path, times))
    assert [f.index for f in frames] == kept
    assert np.all(np.diff([f.time for f in frames]) > 0)
    assert source.skipped == len(times) - len(kept)
    assert all("repeats or runs backwards, skipped" in problem for problem in source.problems)


def test_bad_lines_of_the_list_are_skipped_and_counted(reader, tmp_path):
    listed(tmp_path, [0.0, "oops", "nan", 0.3])
    with (tmp_path / "rgb.txt").open("a") as stream:
        stream.write("0.4\n")
    source, frames = open_all(reader, tmp_path)
    assert [f.index for f in frames] == [0, 3]
    assert source.skipped == 3
    assert "rgb.txt, line 3: 'oops' is not a time in seconds, skipped" in source.problems


def test_one_picture_is_read(reader, tmp_path):
    picture(tmp_path / "only.png")
    source, frames = open_all(reader, tmp_path)
    assert source.length == len(frames) == 1


def test_folders_that_hold_nothing(reader, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    assert reader.recognises(str(empty))
    with pytest.raises(InputError, match="there is no picture in") as caught:
        reader.open(str(empty), ALL)
    assert "rgb.txt" in caught.value.hint
    (empty / "clip.mp4").touch()
    with pytest.raises(InputError, match="there is no picture") as caught:
        reader.open(str(empty), ALL)
    assert "did you mean: droidw run" in caught.value.hint
    with pytest.raises(InputError, match="no such folder"):
        reader.open(str(tmp_path / "missing"), ALL)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is not a folder"):
        reader.open(str(tmp_path / "file"), ALL)
    (empty / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="names no picture"):
        reader.open(str(empty), ALL)


def test_a_folder_of_broken_pictures(reader, tmp_path):
    for i in range(7):
        (tmp_path / f"{i}.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"none of the 7 pictures can be used.*empty"):
        reader.open(str(tmp_path), ALL)


def test_what_it_recognises(reader, tmp_path):
    picture(tmp_path / "kitti" / "image_2" / "0.png")
    listed(tmp_path / "rgbd_dataset_freiburg3_walking", [0.0])
    listed(tmp_path / "plain", [0.0])
    assert not reader.recognises(str(tmp_path / "missing"))
    assert not reader.recognises(str(tmp_path / "kitti"))
    assert not reader.recognises(str(tmp_path / "rgbd_dataset_freiburg3_walking"))
    assert reader.recognises(str(tmp_path / "plain"))


def test_leaving_a_pass_early_leaves_no_thread(reader, tmp_path):
    source = reader.open(str(listed(tmp_path, np.arange(30) / 10)), ALL)
    frames = source.frames()
    next(frames)
    frames.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("droidw-prefetch")]
