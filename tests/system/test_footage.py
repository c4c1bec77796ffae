"""Footage that is missing, broken, short or dull: a sentence, an exit code, nothing lost."""

from __future__ import annotations

import av
import cv2
import numpy as np
import pytest

from droidw.io.tum import read_tum


def write_video(path, images):
    """An MP4 with its index in front, as phones upload it, so that a cut one can be opened."""
    with av.open(str(path), "w", options={"movflags": "frag_keyframe+empty_moov"}) as out:
        stream = out.add_stream("mpeg4", rate=30)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 2_000_000
        stream.codec_context.gop_size = 4
        for image in images:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))
    return path


def refused(ran, code, *words):
    """An error of one sentence and hints, no traceback, and no trajectory."""
    assert ran.code == code, ran.err
    assert "Traceback" not in ran.err
    assert ran.err.startswith("droidw: error: ")
    for word in words:
        assert word in ran.err
    assert not (ran.folder / "trajectory.tum").exists()


def test_every_frame_has_a_pose_with_its_own_stamp(go, footage):
    clip = footage()
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    assert np.allclose(ran.poses[:, 0], clip.times, atol=1e-6)
    assert ran.manifest["frames"] == len(clip.times)
    assert ran.manifest["keyframes"] >= 4
    assert ran.manifest["warnings"] == []


def test_missing_path(go, tmp_path):
    refused(go(tmp_path / "clipp"), 3, "clipp", "there is no such file or folder", "readers:")


def test_missing_video(go, tmp_path):
    refused(go(tmp_path / "clip.mp4"), 3, "clip.mp4")


def test_not_a_video(go, tmp_path):
    path = tmp_path / "notes.mp4"
    path.write_text("this is no video\n" * 50)
    refused(go(path), 3, "notes.mp4")


def test_no_reader_for_it(go, tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("words\n")
    refused(go(path), 3, "notes.txt", "no reader recognises it")


def test_empty_folder(go, tmp_path):
    (tmp_path / "nothing").mkdir()
    refused(go(tmp_path / "nothing"), 3, "nothing", "no picture")


def test_folder_of_broken_pictures(go, footage):
    clip = footage(count=4)
    for path in (clip.folder / "rgb").iterdir():
        path.write_bytes(b"no picture")
    refused(go(clip.folder), 3, "none of the 4 pictures can be used")


def test_video(go, rendered, tmp_path):
    images, _ = rendered("handheld")
    path = write_video(tmp_path / "clip.mp4", images)
    ran = go(path)
    assert ran.code == 0, ran.err
    assert np.allclose(ran.poses[:, 0], np.arange(len(images)) / 30, atol=1e-3)
    assert "a field of view of 60 degrees" in ran.warnings


def test_truncated_video(go, rendered, tmp_path):
    images, _ = rendered("handheld")
    whole = write_video(tmp_path / "whole.mp4", images).read_bytes()
    path = tmp_path / "cut.mp4"
    path.write_bytes(whole[: int(len(whole) * 0.6)])
    ran = go(path, "observers.report={}")
    assert ran.code == 0, ran.err
    assert 5 <= len(ran.poses) < len(images)
    assert len(ran.poses) == ran.manifest["frames"]
    problems = ran.manifest["problems"]
    assert problems, "nothing was said about the missing end"
    assert any(text in ran.warnings for text in problems)
    page = (ran.folder / "report.html").read_text()
    assert any(text.split(":")[-1].strip()[:40] in page for text in problems)


def test_unusable_pictures_in_the_middle(go, footage):
    clip = footage()
    (clip.folder / "rgb" / "0007.png").write_bytes(b"\x89PNG and then nothing")
    (clip.folder / "rgb" / "0008.png").unlink()
    other = np.full((60, 90, 3), 128, np.uint8)
    cv2.imwrite(str(clip.folder / "rgb" / "0012.png"), other)
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    gone = {7, 8, 12}
    left = [t for k, t in enumerate(clip.times) if k not in gone]
    assert np.allclose(ran.poses[:, 0], left, atol=1e-6)
    assert ran.manifest["skipped"] == 3
    assert "3 pictures could not be used" in ran.warnings
    said = "\n".join(ran.manifest["problems"])
    assert "0007.png" in said and "0008.png" in said and "0012.png: 90x60" in said


def test_one_unusable_picture_is_told_apart_from_other_things(go, footage):
    clip = footage(count=12)
    (clip.folder / "rgb.txt").unlink()
    (clip.folder / "rgb" / "0007.png").write_bytes(b"\x89PNG and then nothing")
    (clip.folder / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 nan 0 0 0 1\n")
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    said = ran.manifest["warnings"]
    left_out = [text for text in said if "could not be used" in text]
    assert left_out == ["1 picture could not be used: 0007.png: the file is cut short, skipped"]
    assert any("does not say when its pictures were taken" in text for text in said)


def test_one_frame(go, footage):
    clip = footage(count=1)
    ran = go(clip.folder, "observers.report={}")
    assert ran.code == 0, ran.err
    assert np.allclose(ran.poses, [[0, 0, 0, 0, 0, 0, 0, 1]])
    assert "one frame only" in ran.warnings
    assert (ran.folder / "report.html").stat().st_size > 1000


def test_five_frames(go, footage):
    clip = footage(count=5)
    ran = go(clip.folder, "motion_filter.threshold=0.1")
    assert ran.code == 0, ran.err
    assert np.allclose(ran.poses[:, 0], clip.times, atol=1e-6)


def test_two_frames_with_all_parts(go, footage):
    clip = footage(count=2)
    ran = go(
        clip.folder, "motion_filter.threshold=0.01", "features=cnn",
        "uncertainty=affine-softplus", "exporters.uncertainty={}", "exporters.depth={}",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    assert len(ran.poses) == 2


def test_all_blank(go, footage):
    clip = footage(count=12, blank=range(12))
    ran = go(clip.folder)
    assert ran.code == 4
    assert "nothing could be matched between the 12 frames" in ran.err
    assert np.allclose(ran.poses[:, 0], clip.times[:12], atol=1e-6)
    assert np.allclose(ran.poses[:, 1:], [0, 0, 0, 0, 0, 0, 1])
    assert ran.manifest["frames"] == 12


@pytest.mark.parametrize("grey", [0, 90, 255], ids=["black", "grey", "white"])
def test_blank_in_the_middle(go, footage, grey):
    clip = footage(blank=range(10, 13), grey=grey)
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    assert np.allclose(ran.poses[:, 0], clip.times, atol=1e-6)
    if grey != 90:  # one as bright as the room is told from it only by its lack of texture
        assert "could not be matched with their predecessor" in ran.warnings
    centres = ran.poses[:, 1:4]
    length = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert length.max() < 0.5 * length.sum(), "the blank frames threw the camera away"


@pytest.mark.parametrize("blank", [range(3), range(23, 26)], ids=["start", "end"])
def test_blank_at_an_end(go, footage, blank):
    clip = footage(blank=blank)
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    assert len(ran.poses) == len(clip.times)
    keyframes = read_tum(ran.folder / "keyframes.tum").times
    assert not set(np.round(keyframes, 6)) & set(np.round(np.asarray(clip.times)[list(blank)], 6))
    # nothing hangs on pictures that show nothing: they are where the path begins or ends
    steps = np.linalg.norm(np.diff(ran.poses[:, 1:4], axis=0), axis=1)
    hidden = steps[:3] if blank[0] == 0 else steps[-3:]
    assert hidden.max() <= steps.max() and hidden.sum() < 0.3 * steps.sum()


def test_pure_rotation(go, footage, rendered):
    clip = footage("rotation")
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    assert len(ran.poses) == len(clip.times)
    assert "almost no parallax" in ran.warnings
    _, scene = rendered("rotation")
    truth = scene.trajectory.T_wc[:, 3:]
    turned = [
        np.degrees(2 * np.arccos(min(1, abs(q[-1] @ q[0])))) for q in (ran.poses[:, 4:], truth)
    ]
    assert turned[0] == pytest.approx(turned[1], rel=0.15), "rotations are said to be usable"


def test_still_camera(go, footage):
    clip = footage("static")
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    assert "the camera did not move" in ran.warnings
    assert len(ran.poses) == len(clip.times)
    assert (ran.poses[:, 1:] == ran.poses[0, 1:]).all()


def test_times_that_repeat_or_run_backwards(go, footage):
    times = [k / 30 for k in range(26)]
    times[9] = times[8]
    times[15] = times[4]
    clip = footage(times=times)
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    rising = [t for k, t in enumerate(times) if k not in (9, 15)]
    assert np.allclose(ran.poses[:, 0], rising, atol=1e-6)
    assert ran.manifest["skipped"] == 2
    assert "repeats or runs backwards" in ran.warnings


def test_large_stamps_keep_their_digits(go, footage):
    times = [1_700_000_000.25 + k / 30 for k in range(12)]
    clip = footage(count=12, times=times)
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    assert np.abs(ran.poses[:, 0] - times).max() < 1e-5
