"""Clips to hold defaults against that they were not chosen on: movers of other sizes and places.

What moves in the clips with masks is scaled, shifted in the picture and in time, mirrored and put
together anew, over both scenes with true poses. Whoever tunes on these needs others.

    python benchmarks/unseen.py DATA OUT
    droidw run OUT/NAME --preset cpu threads=1
    droidw eval RUN --masks OUT/NAME/mask --masks-after 12

It writes the clips of CLIPS, those named `..._static` without anything that moves.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from movers import Layer, read_layer
from variants import Clip, Size, read_clip


@dataclass(frozen=True)
class Mover:
    """What moves in a clip, and how it is changed.

    Attributes:
        clip: folder with `rgb/` and `mask/`.
        scale: times as large, about the middle of the lower border. across: shift to the right, as
            a share of the width. mirrored: left and right changed. later: begins so many frames in.
    """

    clip: str
    scale: float = 1.0
    across: float = 0.0
    mirrored: bool = False
    later: int = 0

    def layer(self, data: Path, size: Size, frames: int) -> Layer:
        """Pictures and shares, as of `read_layer`."""
        layer = read_layer(data / self.clip, *size, frames + self.later)[self.later :]
        return [(self._placed(picture), self._placed(share)) for picture, share in layer]

    def _placed(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        height, width = image.shape[:2]
        image = np.ascontiguousarray(image[:, ::-1]) if self.mirrored else image
        left = width / 2 * (1 - self.scale) + self.across * width
        affine = np.array([[self.scale, 0, left], [0, self.scale, height * (1 - self.scale)]])
        placed = cv2.warpAffine(image, affine, (width, height), flags=cv2.INTER_LINEAR)
        return np.asarray(placed, dtype=np.float32)


@dataclass(frozen=True)
class Made:
    """One of CLIPS: a scene, from `first` to before `last`, and what is pasted over it."""

    scene: str
    movers: tuple[Mover, ...]
    size: Size = (320, 240)
    first: int = 0
    last: int | None = None


_KITCHEN, _HOSPITAL = "redkitchen_300", "tartanair_hospital"
_CAMEL, _GOAT = "composite_hospital", "composite_kitchen"  # and their dancers
_RUNNER, _CAR = "davis_parkour", "davis_car-roundabout"
_BOTH = (Mover(_RUNNER, later=40), Mover(_GOAT, mirrored=True))
CLIPS = {
    "kitchen_camel_car": Made(
        _KITCHEN, (Mover(_CAMEL, mirrored=True, later=60), Mover(_CAR, 0.6, -0.2))
    ),
    "kitchen_runner_aside": Made(_KITCHEN, (Mover(_RUNNER, across=0.2),)),
    "kitchen_runner_large": Made(_KITCHEN, (Mover(_RUNNER, 1.5, mirrored=True),)),
    "kitchen_late": Made(_KITCHEN, _BOTH, (480, 360), 100, 300),
    "kitchen_late_static": Made(_KITCHEN, (), (480, 360), 100, 300),
    "hospital_car": Made(_HOSPITAL, (Mover(_CAR, mirrored=True),)),
    "hospital_camel_small": Made(_HOSPITAL, (Mover(_CAMEL, 0.6, 0.15),)),
    "hospital_400": Made(_HOSPITAL, (Mover(_CAMEL, mirrored=True),), (400, 300)),
    "hospital_400_static": Made(_HOSPITAL, (), (400, 300)),
    "hospital_late": Made(_HOSPITAL, (Mover(_GOAT, mirrored=True, later=30),), first=60),
    "hospital_late_static": Made(_HOSPITAL, (), first=60),
    "hospital_runner_camel": Made(
        _HOSPITAL, (Mover(_RUNNER, 1.2, later=20), Mover(_CAMEL, 0.5, -0.25))
    ),
    # Made later, after the masks and paths of those above had been looked at.
    "kitchen_car": Made(_KITCHEN, (Mover(_CAR, mirrored=True, later=5),)),
    "kitchen_goat_camel": Made(
        _KITCHEN, (Mover(_GOAT, 0.8, 0.2), Mover(_CAMEL, 0.7, -0.2)), first=50, last=250
    ),
    "kitchen_middle_static": Made(_KITCHEN, (), first=50, last=250),
    "hospital_goat_small": Made(_HOSPITAL, (Mover(_GOAT, 0.7, -0.15, True, 20),)),
    "hospital_runner_large": Made(_HOSPITAL, (Mover(_RUNNER, 1.4, 0.1, True, 10),)),
    "hospital_480": Made(_HOSPITAL, (Mover(_RUNNER, later=30),), (480, 360), 20),
    "hospital_480_static": Made(_HOSPITAL, (), (480, 360), 20),
    "hospital_car_small": Made(_HOSPITAL, (Mover(_CAR, 0.7, 0.2, later=10),), first=30),
    "hospital_middle_static": Made(_HOSPITAL, (), first=30),
}


def make(data: Path, made: Made) -> Clip:
    """A clip of CLIPS in memory."""
    clip = read_clip(data / made.scene, made.size)
    part = slice(made.first, made.last)
    clip = replace(
        clip,
        pictures=clip.pictures[part],
        masks=[],
        times=clip.times[part],
        poses=clip.poses[part],
    )
    if not made.movers:
        return clip
    return clip.under([m.layer(data, made.size, len(clip.pictures)) for m in made.movers])


def folders(doc: str, argv: Sequence[str] | None) -> tuple[Path, Path]:
    """DATA and OUT as a script with this docstring was asked for them; OUT is not there yet."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the clips that these are made of")
    parser.add_argument("out", type=Path, help="folder to write, not there yet")
    asked = parser.parse_args(argv)
    if asked.out.exists():
        raise SystemExit(f"{asked.out} is there already; name another folder")
    return asked.data, asked.out


def main(argv: Sequence[str] | None = None) -> None:
    """Write the clips."""
    data, out = folders(__doc__, argv)
    for name, made in CLIPS.items():
        clip = make(data, made)
        clip.write(out / name)
        print(f"{name}: {len(clip.pictures)} pictures, {clip.moving:.0%} of them moves")


if __name__ == "__main__":
    main()
