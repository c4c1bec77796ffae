"""Camera poses out of COLMAP's binary images.bin."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt

from droidw.errors import InputError

__all__ = ["read_poses"]

_HEAD = struct.Struct("<i7di")
_COUNT = struct.Struct("<Q")
_POINT = 24
_LONGEST = 4096


def read_poses(path: Path) -> dict[str, npt.NDArray[np.float64]]:
    """Camera-to-world matrix [4,4] of every picture by name, without those that are not finite.

    The file has, per picture: id, quaternion wxyz and translation world to camera, id of the
    camera, name ending in a zero byte, and its points, which are skipped.

    Raises:
        InputError: the file cannot be read or is cut short.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    found: dict[str, npt.NDArray[np.float64]] = {}
    try:
        (count,) = _COUNT.unpack_from(data, 0)
        at = _COUNT.size
        for _ in range(count):
            _, *pose, _ = _HEAD.unpack_from(data, at)
            at += _HEAD.size
            end = data.index(b"\0", at, at + _LONGEST)
            name = data[at:end].decode("utf-8")
            (points,) = _COUNT.unpack_from(data, end + 1)
            at = end + 1 + _COUNT.size + points * _POINT
            if at > len(data):
                raise ValueError("points run past the end")
            matrix = _camera_to_world(np.array(pose))
            if matrix is not None:
                found[name] = matrix
    except (struct.error, ValueError) as error:
        raise InputError(
            f"{path} is cut short or no images.bin of COLMAP ({error})",
            "expected the binary form that COLMAP writes into sparse/",
        ) from error
    return found


def _camera_to_world(pose: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | None:
    """Matrix of qw qx qy qz tx ty tz, inverted; None if it is no pose."""
    length = float(np.linalg.norm(pose[:4]))
    if not np.isfinite(pose).all() or length < 1e-6:
        return None
    w, x, y, z = pose[:4] / length
    R_cw = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    out = np.eye(4)
    out[:3, :3] = R_cw.T
    out[:3, 3] = -R_cw.T @ pose[4:]
    return out
