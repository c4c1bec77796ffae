"""Writes a synthetic sequence as a folder of pictures with its truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from droidw.errors import InputError

if TYPE_CHECKING:
    from droidw.testing.scenes import Scene

__all__ = ["write_scene"]


def write_scene(scene: Scene, folder: Path) -> None:
    """Write `scene` into `folder` (made if it is not there).

    Raises:
        InputError: a picture cannot be written.
    """
    for name in ("rgb", "mask", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    stamps, poses = [], []
    for index in range(len(scene)):
        frame = scene.render(index)
        name = f"{index:06d}.png"
        millimetres = np.clip(np.rint(frame.depth * 1000), 0, 65535).astype(np.uint16)
        _write(folder / "rgb" / name, frame.image[..., ::-1])
        _write(folder / "mask" / name, frame.moving.astype(np.uint8) * 255)
        _write(folder / "depth" / name, millimetres)
        stamps.append(f"{frame.time:.6f} rgb/{name}")
        poses.append(f"{frame.time:.6f} " + " ".join(f"{v:.9f}" for v in frame.T_wc))
    (folder / "rgb.txt").write_text("# timestamp filename\n" + "\n".join(stamps) + "\n")
    (folder / "groundtruth.txt").write_text(
        "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(poses) + "\n"
    )
    fx, fy, cx, cy = (float(v) for v in scene.intrinsics)
    values = {
        "width": scene.spec.width,
        "height": scene.spec.height,
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
    }
    (folder / "camera.txt").write_text(
        "".join(f"{key} {value:.10g}\n" for key, value in values.items())
    )


def _write(path: Path, image: np.ndarray[tuple[int, ...], np.dtype[np.uint8 | np.uint16]]) -> None:
    if not cv2.imwrite(str(path), np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise InputError(f"{path}: cannot be written", "check that the folder is writable")
