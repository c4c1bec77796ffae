"""Videos: true times, rotation, damage, and files that are no video."""

from __future__ import annotations

import numpy as np
import pytest

from droidw.errors import InputError
from droidw.io.notes import Notes
from droidw.io.video import decode_video, probe_video


def decode(path, **options):
    problems: list[str] = []
    notes = Notes(problems)
    frames = list(decode_video(path, notes, **options))
    notes.finish()
    return frames, problems, notes.skipped


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv", "avi"])
def test_every_picture_with_its_time(videos, tmp_path, suffix):
    path = videos.write_video(tmp_path / f"a.{suffix}", count=30, fps=25)
    info = probe_video(path)
    assert (info.width, info.height, info.frames, info.fps) == (96, 64, 30, 25.0)
    assert info.square
    frames, problems, skipped = decode(path)
    assert [f.index for f in frames] == list(range(30))
    np.testing.assert_allclose([f.time for f in frames], np.arange(30) / 25, atol=1e-9)
    assert (problems, skipped) == ([], 0)
    wanted = videos.picture(7)
    assert frames[7].image.shape == wanted.shape
    assert np.median(np.abs(frames[7].image.astype(int) - wanted)) < 12


def test_uneven_times_are_those_of_the_file(videos, tmp_path):
    times = [0, 40, 100, 110, 300, 301, 900]
    frames, _, _ = decode(videos.write_video(tmp_path / "a.mkv", times=times))
    np.testing.assert_allclose([f.time for f in frames], np.array(times) / 1000, atol=1e-9)


def test_reordered_pictures_come_in_order_of_presentation(videos, tmp_path):
    path = videos.write_video(tmp_path / "a.mkv", count=30, codec="mpeg2video")
    frames, _, _ = decode(path)
    assert len(frames) == 30
    assert np.all(np.diff([f.time for f in frames]) > 0)


def test_stride_and_skip_keep_index_and_time(videos, tmp_path):
    path = videos.write_video(tmp_path / "a.mp4", count=20, fps=25)
    frames, _, _ = decode(path, skip=3, stride=5)
    assert [f.index for f in frames] == [3, 8, 13, 18]
    np.testing.assert_allclose([f.time for f in frames], np.array([3, 8, 13, 18]) / 25)


@pytest.mark.parametrize(("turns", "corner"), [(1, (0, -1)), (2, (-1, -1)), (3, (-1, 0))])
def test_a_phone_held_upright_gives_upright_pictures(videos, tmp_path, turns, corner):
    path = videos.turn(videos.write_video(tmp_path / "a.mp4", count=3), turns)
    info = probe_video(path)
    assert (info.width, info.height) == ((64, 96) if turns % 2 else (96, 64))
    image = decode(path)[0][0].image
    assert image.shape[:2] == (info.height, info.width)
    assert image.flags.c_contiguous
    y, x = (3 if c == 0 else -4 for c in corner)
    red, green, _ = image[y, x].astype(int)
    assert red - green > 200


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "avi"])
def test_a_truncated_video_gives_what_is_there_and_says_so(videos, tmp_path, suffix):
    options = {"movflags": "faststart"} if suffix == "mp4" else {}
    path = videos.write_video(tmp_path / f"a.{suffix}", count=60, options=options)
    whole, _, _ = decode(path)
    frames, problems, _ = decode(cut(path, 0.6))
    assert 5 < len(frames) < 55
    assert [f.time for f in frames] == [f.time for f in whole[: len(frames)]]
    assert any("a." + suffix + " is cut short" in problem for problem in problems)


def test_a_last_picture_that_is_shown_for_long_is_no_truncation(videos, tmp_path):
    path = videos.write_video(tmp_path / "a.mp4", times=[0, 40, 80, 5000], hold=4000)
    frames, problems, _ = decode(path)
    assert len(frames) == 4
    assert problems == []
    assert probe_video(path).frames == 4


def test_an_mp4_without_its_index_is_told_from_no_video(videos, tmp_path):
    path = cut(videos.write_video(tmp_path / "a.mp4"), 0.5)
    with pytest.raises(InputError, match="its index is missing, so it was cut short"):
        probe_video(path)


def test_damage_in_the_middle_is_counted_and_the_rest_read(videos, tmp_path):
    path = videos.write_video(tmp_path / "a.avi", count=60)
    data = bytearray(path.read_bytes())
    start = data.index(b"movi")
    rng = np.random.default_rng(0)
    for at in rng.integers(start + (len(data) - start) // 3, start + (len(data) - start) // 2, 80):
        data[at] ^= 0x5A
    path.write_bytes(data)
    frames, problems, skipped = decode(path)
    assert skipped > 0
    assert problems
    assert 10 < len(frames) < 60
    assert frames[-1].time == pytest.approx(59 / 25, abs=0.3)
    assert np.all(np.diff([f.time for f in frames]) > 0)


def test_times_that_repeat_are_skipped_and_counted(videos, tmp_path):
    pictures = [videos.picture(i) for i in range(6)]
    path = videos.write_packets(tmp_path / "a.mkv", pictures, [0, 40, 40, 80, 120, 160])
    frames, problems, skipped = decode(path)
    np.testing.assert_allclose([f.time for f in frames], [0, 0.04, 0.08, 0.12, 0.16])
    assert skipped == 1
    assert problems == ["a.mkv, picture 2: its time 0.040000 s repeats or runs backwards, skipped"]


def test_pictures_of_another_size_are_skipped_and_counted(videos, tmp_path):
    pictures = [videos.picture(i, (64, 48) if i in (2, 3) else (96, 64)) for i in range(6)]
    path = videos.write_packets(tmp_path / "a.mkv", pictures, [0, 40, 80, 120, 160, 200])
    frames, problems, skipped = decode(path)
    assert [f.index for f in frames] == [0, 1, 4, 5]
    assert skipped == 2
    assert "picture 2 is 64x48 pixels where the first has 96x64" in problems[0]


def test_many_problems_do_not_flood(videos, tmp_path):
    pictures = [videos.picture(i, (64, 48) if i else (96, 64)) for i in range(20)]
    path = videos.write_packets(tmp_path / "a.mkv", pictures, range(0, 800, 40))
    _, problems, skipped = decode(path)
    assert skipped == 19
    assert len(problems) == 6
    assert problems[-1] == "14 more pictures of another size skipped"


def test_what_is_no_video(videos, tmp_path):
    (tmp_path / "text.mp4").write_text("this is no video at all\n" * 50)
    (tmp_path / "text.txt").write_text("nor is this\n" * 50)
    (tmp_path / "empty.mp4").touch()
    videos.write_sound(tmp_path / "sound.mp4")
    for name, words in (
        ("text.mp4", "is not a video that can be read"),
        ("text.txt", "is not a video"),
        ("empty.mp4", "is empty"),
        ("sound.mp4", "holds only sound"),
        ("missing.mp4", "no such file"),
        (".", "is not a file"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            probe_video(tmp_path / name)
        assert caught.value.exit_code == 3
        assert "folder of pictures" in caught.value.hint


def test_a_video_without_a_picture(videos, tmp_path):
    path = videos.write_video(tmp_path / "a.mp4", count=10, options={"movflags": "faststart"})
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"mdat") + 4])
    with pytest.raises(InputError, match="not one picture can be decoded"):
        probe_video(path)
