"""Calibrations that do not fit, seen from the command line."""

from __future__ import annotations

import pytest

SAME = "fx 131.2\nfy 131.2\ncx 79.5\ncy 59.5\n"


def test_for_another_size_of_the_same_shape_is_scaled(go, footage, tmp_path):
    calib = tmp_path / "big.txt"
    calib.write_text("width 640\nheight 480\nfx 524.8\nfy 524.8\ncx 319.5\ncy 239.5\n")
    ran = go(footage(count=6).folder, "--calib", calib)
    assert ran.code == 0, ran.err
    assert ran.manifest["intrinsics"]["fx"] == pytest.approx(131.2)
    assert ran.manifest["intrinsics"]["cx"] == pytest.approx(79.5)
    assert "640x480" in ran.manifest["camera"] and "scaled" in ran.manifest["camera"]


def test_of_the_source_for_another_size_is_scaled(go, footage):
    clip = footage(count=6, calib="width 320\nheight 240\nfx 262.4\nfy 262.4\ncx 159.5\ncy 119.5\n")
    ran = go(clip.folder)
    assert ran.code == 0, ran.err
    assert ran.manifest["intrinsics"]["fx"] == pytest.approx(131.2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("width 640\nheight 360\n" + SAME, ("640x360", "160x120", "another shape")),
        ("fx nan\nfy 131\ncx 79.5\ncy 59.5\n", ("fx is nan", "not a finite number")),
        ("131 131 inf 59.5\n", ("cx is inf", "not a finite number")),
        ("131 131 400 59.5\n", ("principal point (400, 59.5) lies outside",)),
        ("131 131 79.5 -40\n", ("principal point (79.5, -40) lies outside",)),
        ("-131 131 79.5 59.5\n", ("focal length is positive",)),
        ("", ("holds no calibration",)),
    ],
)
@pytest.mark.parametrize("place", ["option", "source"])
def test_impossible_is_refused(go, footage, tmp_path, text, words, place):
    if place == "option":
        calib = tmp_path / "calib.txt"
        calib.write_text(text)
        ran = go(footage(count=3).folder, "--calib", calib)
    else:
        ran = go(footage(count=3, calib=text).folder)
    assert ran.code == 3, ran.err
    assert "Traceback" not in ran.err
    for word in ("calib.txt" if place == "option" else "camera.txt", *words):
        assert word in ran.err
    assert not (ran.folder / "trajectory.tum").exists()


def test_two_at_once_are_refused(go, footage):
    ran = go(footage(count=3).folder, "--focal", "100", "--fov", "60")
    assert ran.code == 2
    assert "focal and fov are given" in ran.err
    assert not ran.folder.exists()


def test_missing_file(go, footage, tmp_path):
    ran = go(footage(count=3).folder, "--calib", tmp_path / "none.txt")
    assert ran.code == 3
    assert "none.txt" in ran.err


def test_focal_and_fov_are_used(go, footage):
    clip = footage(count=3)
    assert go(clip.folder, "--focal", "140", to="a").manifest["intrinsics"]["fx"] == 140
    fx = go(clip.folder, "--fov", "90", to="b").manifest["intrinsics"]["fx"]
    assert fx == pytest.approx(80, rel=0.01)
