"""Calibration files: every format, scaling to another size, refusals with file and line."""

from __future__ import annotations

import pytest

from droidw.errors import InputError
from droidw.io.calib import read_calibration


def read(tmp_path, text, name="camera.txt", size=(640, 480)):
    (tmp_path / name).write_text(text)
    return read_calibration(tmp_path / name, *size)


KEYS = """# pinhole + OpenCV k1 k2 p1 p2 k3
width 640
height 480
fx 535.4
fy 539.2
cx 320.1
cy 247.6
dist 0.1 -0.2 0.001 0.002 0.3
fps 30
depth_scale 1 (npy float32 metres)
"""
FIVE = (0.1, -0.2, 0.001, 0.002, 0.3)


@pytest.mark.parametrize(
    ("name", "text", "numbers", "distortion", "model"),
    [
        ("c.txt", KEYS, (535.4, 539.2, 320.1, 247.6), FIVE, "opencv"),
        ("c.txt", "fx: 500\nfy = 501\ncx 318\ncy 242\n", (500, 501, 318, 242), (), "pinhole"),
        (
            "c.txt", "model fisheye\nfx 300\nfy 300\ncx 318\ncy 242\ndist 0.1 0.2 0.3 0.4\n",
            (300, 300, 318, 242), (0.1, 0.2, 0.3, 0.4), "fisheye",
        ),
        ("c.txt", "500 501 318 242\n", (500, 501, 318, 242), (), "pinhole"),
        ("c.txt", "500,501, 318,242\n", (500, 501, 318, 242), (), "pinhole"),
        (
            "c.txt", "500 501 318 242 0.1 -0.2 0.001 0.002 0.3", (500, 501, 318, 242), FIVE,
            "opencv",
        ),
        (
            "c.txt", "500 501 318 242 .1 .2 .3 .4 .5 .6 .7 .8", (500, 501, 318, 242),
            (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8), "opencv",
        ),
        (
            "c.yaml", "width: 640\nheight: 480\ncalibration: [500, 501, 318, 242, 0.1, 0, 0, 0]\n",
            (500, 501, 318, 242), (0.1, 0, 0, 0), "opencv",
        ),
        (
            "cameras.txt", "# Camera list\n1 SIMPLE_PINHOLE 640 480 500 320 240\n",
            (500, 500, 319.5, 239.5), (), "pinhole",
        ),
        ("cameras.txt", "1 PINHOLE 640 480 500 501 320 240", (500, 501, 319.5, 239.5), (),
         "pinhole"),
        (
            "cameras.txt", "1 SIMPLE_RADIAL 640 480 500 320 240 0.1", (500, 500, 319.5, 239.5),
            (0.1, 0, 0, 0), "opencv",
        ),
        (
            "cameras.txt", "1 RADIAL 640 480 500 320 240 0.1 0.2", (500, 500, 319.5, 239.5),
            (0.1, 0.2, 0, 0), "opencv",
        ),
        (
            "cameras.txt", "1 OPENCV 640 480 500 501 320 240 0.1 0.2 0.3 0.4",
            (500, 501, 319.5, 239.5), (0.1, 0.2, 0.3, 0.4), "opencv",
        ),
        (
            "cameras.txt", "1 OPENCV_FISHEYE 640 480 500 501 320 240 0.1 0.2 0.3 0.4",
            (500, 501, 319.5, 239.5), (0.1, 0.2, 0.3, 0.4), "fisheye",
        ),
    ],
)  # fmt: skip
def test_every_format(tmp_path, name, text, numbers, distortion, model):
    camera, note = read(tmp_path, text, name)
    assert (camera.width, camera.height) == (640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(numbers)
    assert camera.distortion == pytest.approx(distortion)
    assert camera.model == model
    assert note == ""


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("c.txt", "500 501 320 240\n"),
        ("c.txt", "width 640\nheight 480\nfx 500\nfy 501\ncx 320\ncy 240\n"),
        ("c.yaml", "width: 640\nheight: 480\ncalibration: [500, 501, 320, 240]\n"),
        ("cameras.txt", "1 PINHOLE 640 480 500 501 320 240"),
    ],
)
def test_half_of_the_size_is_the_middle_of_the_picture(tmp_path, name, text):
    camera, _ = read(tmp_path, text, name)
    assert (camera.cx, camera.cy) == (319.5, 239.5)


def test_half_of_one_side_alone_is_a_measurement(tmp_path):
    camera, _ = read(tmp_path, "500 501 320 240.3\n")
    assert (camera.cx, camera.cy) == (320, 240.3)


def test_a_calibration_for_another_size_is_scaled_with_its_half_pixel_and_said_so(tmp_path):
    camera, note = read(tmp_path, KEYS, size=(320, 240))
    assert (camera.width, camera.height) == (320, 240)
    assert camera.fx == pytest.approx(267.7)
    assert camera.cx == pytest.approx((320.1 + 0.5) / 2 - 0.5)
    assert camera.distortion == FIVE
    assert "640x480" in note
    assert "320x240" in note


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("c.txt", "500 501 320\n", "line 1: 3 numbers; a calibration has 4, 8, 9 or 12"),
        ("c.txt", "# head\n\n500 nan 320 240\n", "line 3: fy is nan"),
        ("c.txt", "500 501 700 240\n", r"line 1: the principal point \(700, 240\) lies outside"),
        ("c.txt", "-500 501 320 240\n", "line 1: fx is -500"),
        ("c.txt", "500 501 320 240\n500 501 320 240\n", "line 2: a second line"),
        ("c.txt", KEYS.replace("fx 535.4", "fx five"), "line 4: 'five' is not a number"),
        ("c.txt", KEYS.replace("fx 535.4", "fx inf"), "lines 2 to 8: fx is inf"),
        ("c.txt", KEYS.replace("fy 539.2\n", ""), "fy not found"),
        ("c.txt", KEYS + "fx 3\n", "line 11: 'fx' was given in line 4 already"),
        ("c.txt", KEYS.replace("cx 320.1", "cx"), "line 6: 'cx' has no value"),
        ("c.txt", KEYS.replace("width 640", "width 640.5"), "line 2: 640.5 is not a size"),
        ("c.txt", KEYS.replace("480", "360").replace("247.6", "180"), "another shape"),
        ("c.txt", KEYS + "model wide\n", "line 11: unknown camera model 'wide'"),
        ("c.txt", "", "holds no calibration"),
        ("c.txt", "hello\n", "fx fy cx cy not found"),
        ("c.yaml", "width: 640\n", "no list under the key 'calibration'"),
        ("c.yaml", "500\n", "not valid YAML"),
        ("c.yaml", "width: [640\nheight: 480\n", "line 2: not valid YAML"),
        ("c.yaml", "width: 640\nheight: 480\ncalibration: [1, 2, x, 4]\n", "line 3: 'x' is not"),
        ("c.yaml", "calibration: [500, 500, -9, 240]\n", "line 1: the principal point"),
        ("c.txt", "1 PINHOLE 640 480 500 501 320\n", "line 1: 5 numbers after PINHOLE"),
        (
            "c.txt", "1 PINHOLE 640 480 500 501 320 240\n2 PINHOLE 640 480 400 401 320 240\n",
            "2 different cameras",
        ),
    ],
)  # fmt: skip
def test_refusals_name_file_and_line(tmp_path, name, text, words):
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, text, name)
    assert name in str(caught.value)
    assert caught.value.exit_code == 3


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_calibration(tmp_path / "c.txt", 640, 480)
    with pytest.raises(InputError, match="is a folder"):
        read_calibration(tmp_path, 640, 480)


@pytest.mark.parametrize(("centre", "far"), [("319.5 239.5", True), ("159.5 119.5", False)])
def test_a_calibration_of_twice_the_size_is_told_of(tmp_path, caplog, centre, far):
    (tmp_path / "c.txt").write_text(f"400 400 {centre} -0.1 0.01 0 0\n")
    read_calibration(tmp_path / "c.txt", 320, 240)
    assert any("lies far from the middle" in r.getMessage() for r in caplog.records) == far
