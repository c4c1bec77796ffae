"""Clips made of real ones: with other movers pasted over them, in reverse, and mirrored.

Two clips with the same scene and camera tell what is luck in a figure: mirrored, a clip is as hard
and rounded otherwise. In reverse it is another task, as it begins where the first one ends.

    python benchmarks/variants.py DATA OUT [--size 320x240]
    droidw run OUT/NAME --preset cpu threads=1

It writes the clips of CLIPS, each also with `_mirrored`, `_reversed` and
`_reversed_mirrored` behind its name, and says how much of each moves.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from movers import Layer, middle, over, read_layer

from droidw.eval.mask_files import read_mask
from droidw.io.calib import read_calibration
from droidw.io.images import list_images, read_image
from droidw.io.tum import read_tum, write_tum
from droidw.slam.frame import Trajectory

CLIPS = (  # name, what is seen, what is pasted over it
    ("hospital", "tartanair_hospital", ""),
    ("hospital_camel", "composite_hospital", ""),
    ("hospital_goat", "tartanair_hospital", "composite_kitchen"),
    ("hospital_runner", "tartanair_hospital", "davis_parkour+davis_car-roundabout"),
    ("kitchen", "redkitchen_300", ""),
    ("kitchen_goat", "composite_kitchen", ""),
    ("kitchen_camel", "redkitchen_300", "composite_hospital"),
    ("kitchen_runner", "redkitchen_300", "davis_parkour+davis_car-roundabout"),
)
Size = tuple[int, int]  # width, height


@dataclass(frozen=True)
class Clip:
    """A clip in memory.

    Attributes:
        pictures: [H,W,3] uint8 each. masks: [H,W] bool each, or none at all.
        times: seconds. poses: rows of `tx ty tz qx qy qz qw`, camera to world, one a picture.
        pinhole: fx, fy, cx, cy in pixels.
    """

    pictures: list[npt.NDArray[np.uint8]]
    masks: list[npt.NDArray[np.bool_]]
    times: npt.NDArray[np.float64]
    poses: npt.NDArray[np.float64]
    pinhole: tuple[float, float, float, float]

    @property
    def size(self) -> Size:
        """Width and height of its pictures."""
        height, width = self.pictures[0].shape[:2]
        return width, height

    @property
    def moving(self) -> float:
        """Share of its pixels that moves."""
        return float(np.mean(self.masks)) if self.masks else 0.0

    def mirrored(self) -> Clip:
        """Left and right changed in all pictures, and so in the world."""
        width, _ = self.size
        fx, fy, cx, cy = self.pinhole
        return replace(
            self,
            pictures=[picture[:, ::-1] for picture in self.pictures],
            masks=[mask[:, ::-1] for mask in self.masks],
            poses=self.poses * (-1, 1, 1, 1, -1, -1, 1),
            pinhole=(fx, fy, width - 1 - cx, cy),
        )

    def reversed(self) -> Clip:
        """From the last picture to the first."""
        return replace(
            self,
            pictures=self.pictures[::-1],
            masks=self.masks[::-1],
            times=np.round(self.times[-1] + self.times[0] - self.times[::-1], 6),
            poses=self.poses[::-1],
        )

    def under(self, layers: list[Layer]) -> Clip:
        """With what moves elsewhere over it."""
        pasted = [over(picture, layers, k) for k, picture in enumerate(self.pictures)]
        return replace(
            self, pictures=[p for p, _ in pasted], masks=[moving for _, moving in pasted]
        )

    def write(self, folder: Path) -> None:
        """As a folder that `droidw run` and `droidw eval` read."""
        names = [f"{k:06d}.png" for k in range(len(self.pictures))]
        for part, pictures in (
            ("rgb", [picture[..., ::-1] for picture in self.pictures]),
            ("mask", [mask.astype(np.uint8) * 255 for mask in self.masks]),
        ):
            if not pictures:
                continue
            (folder / part).mkdir(parents=True)
            for name, picture in zip(names, pictures, strict=True):
                cv2.imwrite(str(folder / part / name), picture)
        rows = zip(self.times, names, strict=True)
        (folder / "rgb.txt").write_text("".join(f"{t:.6f} rgb/{name}\n" for t, name in rows))
        write_tum(folder / "groundtruth.txt", Trajectory(self.times, self.poses))
        camera = zip(("fx", "fy", "cx", "cy"), self.pinhole, strict=True)
        width, height = self.size
        lines = [f"width {width}", f"height {height}", *(f"{key} {v:.6f}" for key, v in camera)]
        (folder / "camera.txt").write_text("\n".join(lines) + "\n")


def read_clip(folder: Path, size: Size) -> Clip:
    """A clip with true poses, brought to a size."""
    pictures, masks = (
        list_images(folder / n) if (folder / n).is_dir() else [] for n in ("rgb", "mask")
    )
    known = read_tum(folder / "groundtruth.txt")
    truth = dict(zip(known.times.tolist(), known.T_wc, strict=True))
    times = np.loadtxt(folder / "rgb.txt", usecols=0, ndmin=1)
    if not set(times.tolist()) <= set(truth) or len(times) != len(pictures):
        raise SystemExit(f"{folder}: every picture needs a row of rgb.txt and a true pose")
    camera, _ = read_calibration(folder / "camera.txt", *size)
    return Clip(
        [_small(read_image(path), size) for path in pictures],
        [_small(read_mask(path).astype(np.uint8) * 255, size) > 127 for path in masks],
        times,
        np.array([truth[time] for time in times.tolist()]),
        (camera.fx, camera.fy, camera.cx, camera.cy),
    )


def _small(image: npt.NDArray[np.uint8], size: Size) -> npt.NDArray[np.uint8]:
    small = middle(image.astype(np.float32), *size)
    return np.clip(np.rint(small), 0, 255).astype(np.uint8)


def _size(text: str) -> Size:
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"{text!r} is no size; write WIDTHxHEIGHT, as 640x480")
    return int(width), int(height)


def main(argv: Sequence[str] | None = None) -> None:
    """Write the clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the clips that these are made of")
    parser.add_argument("out", type=Path, help="folder to write, not there yet")
    parser.add_argument(
        "--size", type=_size, default=(320, 240), help="WIDTHxHEIGHT of all of them (320x240)"
    )
    asked = parser.parse_args(argv)
    if asked.out.exists():
        raise SystemExit(f"{asked.out} is there already; name another folder")
    for name, scene, movers in CLIPS:
        clip = read_clip(asked.data / scene, asked.size)
        if movers:
            count = len(clip.pictures)
            folders = [asked.data / mover for mover in movers.split("+")]
            clip = clip.under([read_layer(f, *asked.size, count) for f in folders])
        back = clip.reversed()
        clip.write(asked.out / name)
        clip.mirrored().write(asked.out / f"{name}_mirrored")
        back.write(asked.out / f"{name}_reversed")
        back.mirrored().write(asked.out / f"{name}_reversed_mirrored")
        print(f"{name}: {len(clip.pictures)} pictures, {clip.moving:.0%} of them moves")


if __name__ == "__main__":
    main()
