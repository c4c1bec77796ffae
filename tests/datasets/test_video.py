"""Reader `video`: what it recognises, lengths, selection, damage."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from droidw.errors import InputError
from droidw.interfaces.datasets import DatasetReader, FrameSource, Selection
from droidw_plugins.datasets.video import COMPONENT, VideoOptions


@pytest.fixture
def reader():
    return COMPONENT.factory(VideoOptions(), None)


def test_it_keeps_the_contract(reader, videos, tmp_path):
    assert isinstance(reader, DatasetReader)
    source = reader.open(str(videos.write_video(tmp_path / "clip.mp4", count=25)), Selection())
    assert isinstance(source, FrameSource)
    assert (source.name, source.length, source.size) == ("clip", 25, (96, 64))
    first, second = list(source.frames()), list(source.frames())
    assert [f.time for f in first] == [f.time for f in second]
    np.testing.assert_array_equal(first[20].image, second[20].image)
    assert (source.camera, source.truth, source.problems, source.skipped) == (None, None, [], 0)


def test_selection(reader, videos, tmp_path):
    path = str(videos.write_video(tmp_path / "clip.mp4", count=25))
    source = reader.open(path, Selection(stride=4, skip=2, max_frames=3))
    frames = list(source.frames())
    assert [f.index for f in frames] == [2, 6, 10]
    assert source.length == 3
    assert source.problems == []
    assert reader.open(path, Selection(stride=4, skip=2)).length == 6
    with pytest.raises(InputError, match=r"input\.skip=25 leaves none"):
        reader.open(path, Selection(skip=25))


def test_a_truncated_video_is_read_as_far_as_it_goes(reader, videos, tmp_path):
    path = videos.write_video(tmp_path / "clip.mkv", count=60)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = reader.open(str(path), Selection())
    count = len(list(source.frames()))
    assert 5 < count < 60
    assert "cut short" in source.problems[-1]
    before = list(source.problems)
    assert len(list(source.frames())) == count
    assert source.problems == before


def test_skipped_pictures_are_counted_once(reader, videos, tmp_path):
    pictures = [videos.picture(i) for i in range(6)]
    path = videos.write_packets(tmp_path / "a.mkv", pictures, [0, 40, 40, 80, 80, 160])
    source = reader.open(str(path), Selection())
    for _ in range(2):
        assert len(list(source.frames())) == 4
        assert source.skipped == 2
        assert len(source.problems) == 2


def test_what_it_recognises(reader, videos, tmp_path):
    videos.write_video(tmp_path / "clip.mkv", count=2).rename(tmp_path / "clip")
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "folder.mp4").mkdir()
    assert reader.recognises("missing.MP4")
    assert reader.recognises(str(tmp_path / "clip"))
    assert not reader.recognises(str(tmp_path / "notes.txt"))
    assert not reader.recognises(str(tmp_path / "folder.mp4"))
    assert not reader.recognises(str(tmp_path / "missing"))


def test_leaving_a_pass_early_leaves_no_thread(reader, videos, tmp_path):
    source = reader.open(str(videos.write_video(tmp_path / "clip.mp4", count=25)), Selection())
    frames = source.frames()
    next(frames)
    frames.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("droidw-prefetch")]
