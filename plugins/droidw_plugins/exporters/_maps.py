"""Maps as 16-bit pictures and their scales, written as a whole or not at all."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from droidw.errors import UsageError
from droidw.io.files import atomic_write

__all__ = ["make_folder", "write_map"]


def make_folder(path: Path) -> None:
    """Make a folder of a run, if it is not there yet.

    Raises:
        UsageError: it cannot be made.
    """
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"cannot make the folder {path}: {error.strerror or error}",
            "choose another output folder with -o RUNDIR, or make this one writable",
        ) from error


def write_map(path: Path, values: npt.NDArray[np.uint16] | npt.NDArray[np.uint8]) -> None:
    """Write a map [h,w] as a grey PNG of 16 or 8 bits.

    Raises:
        UsageError: the file cannot be written.
    """
    done, data = cv2.imencode(".png", values)
    if not done:
        raise ValueError(f"OpenCV cannot write a PNG of shape {values.shape}, {values.dtype}")
    with atomic_write(path) as stream:
        stream.write(data.tobytes())
