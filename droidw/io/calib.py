"""Calibration files of several kinds, read into a `Camera`."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from omegaconf import OmegaConf
from yaml import YAMLError  # type: ignore[import-untyped, unused-ignore]

from droidw.errors import InputError
from droidw.geometry.camera import Camera
from droidw.io.files import read_text

__all__ = ["read_calibration"]

_log = logging.getLogger(__name__)

_VALID = """valid are
`key value` lines: width height fx fy cx cy, and dist k1 k2 p1 p2 [k3 ...] if there is any;
one line fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]] in pixels;
YAML with width, height and calibration: [fx, fy, cx, cy, k1, ...];
COLMAP's cameras.txt with one camera"""

# COLMAP model -> how its parameters map to (fx, fy, cx, cy), distortion, and the model here.
_COLMAP: dict[str, tuple[tuple[int, int, int, int], tuple[int | None, ...], str]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), (), "pinhole"),
    "PINHOLE": ((0, 1, 2, 3), (), "pinhole"),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3, None, None, None), "opencv"),
    "RADIAL": ((0, 0, 1, 2), (3, 4, None, None), "opencv"),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7), "opencv"),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11), "opencv"),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7), "fisheye"),
}
_COLMAP_NUMBERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "FULL_OPENCV": 12, "OPENCV_FISHEYE": 8,
}  # fmt: skip
_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
_Lines = list[tuple[int, list[str]]]


def read_calibration(path: Path | str, width: int, height: int) -> tuple[Camera, str]:
    """Read a calibration for pictures of `width` x `height` pixels.

    One for another size with the same aspect (to half a percent) is scaled. COLMAP counts the
    centre of the first pixel as (0.5, 0.5), so half a pixel is taken off its principal point; and
    off one at exactly half of width and height, which is the middle of a picture counted so.
    A file without a size is taken to be for these pictures.

    Returns:
        The camera of the raw pictures, and a sentence about scaling, "" if there was none.
    Raises:
        InputError: the file cannot be read, holds an impossible number (with file and line), or
            is for pictures of another shape.
    """
    path = Path(path)
    text = read_text(path, "a camera calibration")
    lines = [
        (number, fields)
        for number, line in enumerate(text.splitlines(), 1)
        if (fields := re.split(r"[\s,]+", line.split("#", 1)[0].strip(" \t,"))) != [""]
    ]
    if not lines:
        raise InputError(f"{path} holds no calibration", _VALID)
    if path.suffix.lower() in (".yaml", ".yml"):
        camera, where = _from_yaml(path, text, width, height)
    elif len(lines[0][1]) > 1 and lines[0][1][1] in _COLMAP:
        camera, where = _from_colmap(path, lines)
    elif all(_is_number(field) for field in lines[0][1]):
        camera, where = _from_droid(path, lines, width, height)
    else:
        camera, where = _from_keys(path, lines, width, height)
    camera, note = _fit(_centred(camera.validated(where), where), width, height, where)
    if not (0.2 < camera.cx / width < 0.8 and 0.2 < camera.cy / height < 0.8):
        _log.warning(
            "%s: its principal point (%g, %g) lies far from the middle of pictures of %dx%d "
            "pixels: is it for another size? then say width and height in it",
            where, camera.cx, camera.cy, width, height,
        )  # fmt: skip
    return camera, note


def _centred(camera: Camera, where: str) -> Camera:
    """The camera with its axis in the middle, where it is said to be at half of the size.

    No measurement ends at exactly (320, 240) of 640x480: that is what renderers and data sheets
    call the middle, which is (319.5, 239.5) where pixel centres are at integers.
    """
    if (camera.cx, camera.cy) != (camera.width / 2, camera.height / 2):
        return camera
    middle = replace(camera, cx=(camera.width - 1) / 2, cy=(camera.height - 1) / 2)
    _log.info(
        "%s: a principal point at half of the size is the middle of the picture, here (%g, %g)",
        where, middle.cx, middle.cy,
    )  # fmt: skip
    return middle


def _fit(camera: Camera, width: int, height: int, where: str) -> tuple[Camera, str]:
    """The camera for this size, scaled if need be and possible."""
    if (camera.width, camera.height) == (width, height):
        return camera, ""
    sizes = f"{camera.width}x{camera.height}"
    if abs(camera.width * height / (camera.height * width) - 1.0) > 0.005:
        raise InputError(
            f"{where}: the calibration is for {sizes} pixels, but the pictures have "
            f"{width}x{height}, which is another shape",
            "give the calibration of these pictures, or leave it out to have one guessed",
        )
    note = (
        f"{where}: the calibration is for {sizes} pixels and was scaled to the pictures' "
        f"{width}x{height}"
    )
    return camera.resized(width, height), note


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(fields: Sequence[Any], where: str) -> list[float]:
    out = []
    for field in fields:
        try:
            out.append(float(field))
        except (TypeError, ValueError) as error:
            raise InputError(f"{where}: '{field}' is not a number", _VALID) from error
    return out


def _size(value: float, where: str) -> int:
    if not (value.is_integer() and 1 <= value <= 1_000_000):
        raise InputError(f"{where}: {value:g} is not a size in pixels", _VALID)
    return int(value)


def _camera(width: int, height: int, numbers: list[float], where: str) -> Camera:
    """From fx fy cx cy and coefficients in OpenCV's order."""
    if len(numbers) not in (4, 8, 9, 12):
        raise InputError(
            f"{where}: {len(numbers)} numbers; a calibration has 4, 8, 9 or 12",
            "fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]] in pixels",
        )
    model: Literal["opencv", "pinhole"] = "opencv" if len(numbers) > 4 else "pinhole"
    fx, fy, cx, cy = numbers[:4]
    return Camera(width, height, fx, fy, cx, cy, tuple(numbers[4:]), model)


def _from_droid(path: Path, lines: _Lines, width: int, height: int) -> tuple[Camera, str]:
    number, fields = lines[0]
    where = f"{path}, line {number}"
    if len(lines) > 1:
        raise InputError(
            f"{path}, line {lines[1][0]}: a second line, but a calibration of bare numbers has one",
            _VALID,
        )
    return _camera(width, height, _numbers(fields, where), where), where


def _from_keys(path: Path, lines: _Lines, width: int, height: int) -> tuple[Camera, str]:
    found: dict[str, float] = {}
    distortion: list[float] = []
    model = ""
    at: dict[str, int] = {}
    for number, fields in lines:
        where = f"{path}, line {number}"
        key, *rest = [field for field in re.split(r"[:=\s]+", " ".join(fields)) if field]
        if key not in (*_KEYS, "dist", "model"):
            continue  # such as fps and depth_scale
        if key in at:
            raise InputError(f"{where}: '{key}' was given in line {at[key]} already", _VALID)
        if not rest:
            raise InputError(f"{where}: '{key}' has no value", _VALID)
        at[key] = number
        if key == "model":
            model = rest[0].lower()
            if model not in ("pinhole", "opencv", "fisheye"):
                raise InputError(
                    f"{where}: unknown camera model '{model}'", "valid: pinhole, opencv, fisheye"
                )
        elif key == "dist":
            distortion = _numbers(rest, where)
        else:
            found[key] = _numbers(rest[:1], where)[0]
    missing = [key for key in ("fx", "fy", "cx", "cy") if key not in found]
    if missing:
        raise InputError(f"{path} is no calibration: {' '.join(missing)} not found", _VALID)
    w = _size(found["width"], f"{path}, line {at['width']}") if "width" in found else width
    h = _size(found["height"], f"{path}, line {at['height']}") if "height" in found else height
    fx, fy, cx, cy = (found[key] for key in ("fx", "fy", "cx", "cy"))
    where = f"{path}, lines {min(at.values())} to {max(at.values())}"
    if model == "fisheye":
        return Camera(w, h, fx, fy, cx, cy, tuple(distortion), "fisheye"), where
    return _camera(w, h, [fx, fy, cx, cy, *distortion], where), where


def _from_yaml(path: Path, text: str, width: int, height: int) -> tuple[Camera, str]:
    try:
        data = OmegaConf.to_container(OmegaConf.create(text))
    except (YAMLError, AssertionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}, line {mark.line + 1}" if mark is not None else str(path)
        raise InputError(f"{where}: not valid YAML", _VALID) from error
    if not isinstance(data, dict) or not isinstance(data.get("calibration"), list):
        raise InputError(f"{path}: no list under the key 'calibration'", _VALID)
    line = next(
        (n for n, row in enumerate(text.splitlines(), 1) if row.lstrip().startswith("calibration")),
        1,
    )
    where = f"{path}, line {line}"
    sizes = _numbers([data.get("width", width), data.get("height", height)], str(path))
    w, h = (_size(value, f"{path}, width and height") for value in sizes)
    return _camera(w, h, _numbers(data["calibration"], where), where), where


def _from_colmap(path: Path, lines: _Lines) -> tuple[Camera, str]:
    number, fields = lines[0]
    where = f"{path}, line {number}"
    if any(other[1:] != fields[1:] for _, other in lines[1:]):
        raise InputError(
            f"{path} holds {len(lines)} different cameras, but a video has one",
            "keep the line of the camera that took these pictures",
        )
    name = fields[1]
    numbers = _numbers(fields[2:], where)
    if len(numbers) != 2 + _COLMAP_NUMBERS[name]:
        raise InputError(
            f"{where}: {len(numbers)} numbers after {name}, expected width, height and "
            f"{_COLMAP_NUMBERS[name]} parameters"
        )
    w, h = (_size(value, where) for value in numbers[:2])
    four, bent, model = _COLMAP[name]
    values = numbers[2:]
    fx, fy, cx, cy = (values[i] for i in four)
    distortion = tuple(0.0 if i is None else values[i] for i in bent)
    camera = Camera(w, h, fx, fy, cx - 0.5, cy - 0.5, distortion)
    if model != "pinhole":
        camera = replace(camera, model="fisheye" if model == "fisheye" else "opencv")
    return camera, where
