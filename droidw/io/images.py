"""Pictures: finding them in a folder, in natural order, and decoding one."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from droidw.errors import InputError

__all__ = ["IMAGE_SUFFIXES", "list_images", "natural_key", "read_image"]

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm"})


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which frame10.png comes after frame9.png."""
    parts = re.split(r"(\d+)", name.casefold())
    return tuple((1, int(p), p) if p.isdigit() else (0, 0, p) for p in parts if p)


def list_images(folder: Path) -> list[Path]:
    """The pictures right in a folder, in natural order; hidden files are left out.

    Raises:
        InputError: the folder cannot be listed.
    """
    try:
        found = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
        ]
    except OSError as error:
        raise InputError(f"{folder} cannot be listed: {error.strerror or error}") from error
    return sorted(found, key=lambda path: (natural_key(path.name), path.name))


def read_image(path: Path) -> npt.NDArray[np.uint8]:
    """Decode a picture as RGB [H,W,3] uint8, turned as its EXIF tag says.

    Raises:
        InputError: it is missing, empty, cut short or no picture; the message does not repeat
            the path.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise InputError("no such file") from error
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})") from error
    if not data:
        raise InputError("the file is empty")
    # The decoders fill up what is missing with grey, so the end mark has to be looked for.
    png_cut = data[:4] == b"\x89PNG" and b"IEND" not in data[-64:]
    if png_cut or (data[:2] == b"\xff\xd8" and _jpeg_is_cut(data)):
        raise InputError("the file is cut short")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise InputError("cannot be decoded") from error
    if picture is None:
        raise InputError("cannot be decoded")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _jpeg_is_cut(data: bytes) -> bool:
    """Whether no end mark follows the first scan; a thumbnail in the header has its own."""
    at = 2
    while data[at : at + 1] == b"\xff" and at + 4 <= len(data):
        if data[at + 1] == 0xFF:
            at += 1  # padding before a mark
            continue
        if data[at + 1] == 0xDA:
            return data.find(b"\xff\xd9", at) < 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return True
