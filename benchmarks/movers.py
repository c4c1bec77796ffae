"""Rendered rooms, alone and with what moves in real footage pasted over: clips for `droidw ablate`.

A room has exact poses, and texture enough that what is left of the error is what moving things and
their covering cost. What moves comes from folders with `rgb/` and `mask/`, of which DATA has
several; the pictures are cropped to the middle and played to and fro where they are too few.

    python benchmarks/movers.py DATA OUT [--movers CLIP[+CLIP],...] [--frames 160]
    droidw ablate cpu --data OUT --seeds 0 --jobs 2 --sequences ... --rows full,a-no-uncertainty

For each room it writes OUT/NAME (static) and OUT/NAME_moving with masks, and prints the second
command.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from droidw.eval.mask_files import read_mask
from droidw.io.images import list_images, read_image
from droidw.testing.scenes import Scene, SceneSpec

Layer = list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]
"""Pictures [H,W,3] of what moves, and the share [H,W] of each pixel that it covers."""

MOVERS = "composite_kitchen,composite_hospital,davis_parkour+davis_car-roundabout"
ROOMS = (  # camera path, width, height, pictures per second
    ("handheld", 320, 240, 20.0),
    ("handheld", 320, 240, 20.0),
    ("orbit", 320, 240, 20.0),
    ("forward", 320, 240, 20.0),
    ("handheld", 480, 270, 20.0),
    ("orbit", 240, 320, 10.0),
)


def read_layer(folder: Path, width: int, height: int, frames: int) -> Layer:
    """What moves in a clip, as large as the room's pictures, as many frames as asked for."""
    pictures, masks = (list_images(folder / name) for name in ("rgb", "mask"))
    if len(pictures) != len(masks) or not pictures:
        raise SystemExit(f"{folder}: {len(pictures)} pictures and {len(masks)} masks")
    there = []
    for picture, mask in list(zip(pictures, masks, strict=True))[:frames]:
        image, share = read_image(picture), read_mask(mask)
        both = (middle(part.astype(np.float32), width, height) for part in (image, share))
        there.append(tuple(both))
    to_and_fro = there + there[-2:0:-1]
    return [to_and_fro[k % len(to_and_fro)] for k in range(frames)]


def middle(image: npt.NDArray[np.float32], width: int, height: int) -> npt.NDArray[np.float32]:
    """The middle of a picture, resized so that it just fills width x height."""
    scale = max(width / image.shape[1], height / image.shape[0])
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    shrink = scale < 1
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    x, y = (size[0] - width) // 2, (size[1] - height) // 2
    return np.asarray(image[y : y + height, x : x + width], dtype=np.float32)


def paste(folder: Path, made: Path, layers: list[Layer]) -> float:
    """Write `made`: the clip in `folder` with the layers over it. Returns the covered share."""
    for name in ("rgb", "mask"):
        (made / name).mkdir(parents=True)
    for name in ("rgb.txt", "groundtruth.txt", "camera.txt"):
        shutil.copy(folder / name, made / name)
    shares = []
    for k, path in enumerate(list_images(folder / "rgb")):
        picture, moving = over(read_image(path), layers, k)
        cv2.imwrite(str(made / "rgb" / path.name), picture[..., ::-1])
        cv2.imwrite(str(made / "mask" / path.name), moving.astype(np.uint8) * 255)
        shares.append(moving.mean())
    return float(np.mean(shares))


def over(
    picture: npt.NDArray[np.uint8], layers: list[Layer], k: int
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
    """Picture number k [H,W,3] with the layers over it, and what of it [H,W] is theirs."""
    image = picture.astype(np.float32)
    moving = np.zeros(image.shape[:2], bool)
    for layer in layers:
        mover, share = layer[k]
        image += share[..., None] * (mover - image)
        moving |= share > 0.5
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), moving


def main(argv: Sequence[str] | None = None) -> None:
    """Write the clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of clips with masks")
    parser.add_argument("out", type=Path, help="folder to write, not there yet")
    parser.add_argument("--movers", default=MOVERS, help=f"clips of DATA ({MOVERS})")
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--rooms", type=int, default=len(ROOMS), help="only the first so many")
    asked = parser.parse_args(argv)
    if asked.out.exists():
        raise SystemExit(f"{asked.out} is there already; name another folder")
    movers = asked.movers.split(",")
    names = []
    for number, (motion, width, height, fps) in enumerate(ROOMS[: asked.rooms]):
        name = f"room{number}_{motion}"
        folder, clips = asked.out / name, movers[number % len(movers)].split("+")
        spec = SceneSpec(width, height, asked.frames, fps, number + 1, False, motion)
        Scene(spec).write(folder)
        shutil.rmtree(folder / "mask")
        layers = [read_layer(asked.data / clip, width, height, asked.frames) for clip in clips]
        share = paste(folder, asked.out / f"{name}_moving", layers)
        print(f"{name}: {'+'.join(clips)} over {share:.0%} of it")
        names += [name, f"{name}_moving"]
    print(f"droidw ablate cpu --data {asked.out} --seeds 0 --sequences {','.join(names)}")


if __name__ == "__main__":
    main()
