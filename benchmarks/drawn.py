"""Clips drawn by lot: what nobody chose, to hold defaults against.

Each is a scene with true poses (real, or rendered with a seed of its own), a part of it, mirrored
or in reverse or at half the frame rate, and one or two of what moves in real clips over it, at a
size, place and time that are drawn too; then exposure that swings, and JPEG. What moves or comes
near too much is drawn again.

    python benchmarks/drawn.py DATA OUT [--count 8] [--seed 0]
    droidw run OUT/NAME --preset cpu threads=1

It writes OUT/NAME and OUT/NAME_static, the same without what moves. A seed always draws the same
clips; whoever has tuned on some of them draws others.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scenery import SCENES as SCENERY
from scenery import Renderer
from unseen import Mover
from variants import Clip, Size, read_clip

from droidw.testing.scenes import Scene, SceneSpec

Image = npt.NDArray[np.uint8]

FAST = "redkitchen_300"  # 30 pictures a second, so that every second one is enough
REAL = (FAST, "tartanair_hospital")
ROOMS = ("handheld", "orbit", "forward")  # camera paths
MOVERS = ("composite_kitchen", "composite_hospital", "davis_parkour", "davis_car-roundabout")
SIZES: tuple[Size, ...] = ((320, 240), (320, 240), (400, 300), (480, 360))
SHARE = 0.05, 0.4  # of the pixels that may move; others are drawn again
LEAST_FRAMES = 90
CLEARANCE = 0.4  # metres; a camera that comes nearer to a rendered thing may pass through it


@dataclass(frozen=True)
class Drawn:
    """What was drawn for one clip.

    Attributes:
        scene: a clip of REAL, a path of ROOMS or a scene of SCENERY.
        seed: of what is rendered. size: of the pictures, where the scene leaves it open.
        first: the first picture. frames: how many pictures of the scene. step: each, or every
            second one. mirrored, backwards: left and right, begin and end are changed.
        movers: what is pasted over it.
        swing: exposure goes up and down by this share. jpeg: quality; 0 is none.
    """

    scene: str
    seed: int
    size: Size
    first: int
    frames: int
    step: int
    mirrored: bool
    backwards: bool
    movers: tuple[Mover, ...]
    swing: float
    jpeg: int


def draw(rng: np.random.Generator) -> Drawn:
    """One clip."""
    scene = str(rng.choice([*REAL, *REAL, *ROOMS, *SCENERY]))
    frames = int(rng.integers(110, 190))
    movers = tuple(
        Mover(
            str(name),
            scale=round(float(rng.uniform(0.5, 1.5)), 2),
            across=round(float(rng.uniform(-0.3, 0.3)), 2),
            mirrored=bool(rng.integers(2)),
            later=int(rng.integers(60)),
        )
        for name in rng.choice(MOVERS, size=rng.integers(1, 3), replace=False)
    )
    return Drawn(
        scene=scene,
        seed=int(rng.integers(1000, 10000)),
        size=SIZES[rng.integers(len(SIZES))],
        first=int(rng.integers(60)),
        frames=frames,
        step=2 if scene == FAST and rng.integers(2) else 1,
        mirrored=bool(rng.integers(2)),
        backwards=bool(rng.integers(2)),
        movers=movers,
        swing=float(rng.choice([0.0, 0.0, 0.1, 0.2])),
        jpeg=int(rng.choice([0, 92, 80])),
    )


def still(data: Path, drawn: Drawn) -> Clip | None:
    """The scene of a clip, without what moves; None if the camera runs into it."""
    if drawn.scene in REAL:
        clip = read_clip(data / drawn.scene, drawn.size)
        last = len(clip.pictures)
        first = min(drawn.first, last - LEAST_FRAMES)
        kept = slice(first, min(first + drawn.frames * drawn.step, last), drawn.step)
        clip = replace(
            clip, pictures=clip.pictures[kept], times=clip.times[kept], poses=clip.poses[kept]
        )
    elif drawn.scene in ROOMS:
        clip = _room(drawn)
    else:
        renderer = Renderer(replace(SCENERY[drawn.scene], frames=drawn.frames), drawn.seed)
        if renderer.clearance() < CLEARANCE:
            return None
        clip = renderer.clip()
    clip = clip.reversed() if drawn.backwards else clip
    return clip.mirrored() if drawn.mirrored else clip


def _room(drawn: Drawn) -> Clip:
    width, height = drawn.size
    scene = Scene(SceneSpec(width, height, drawn.frames, 20.0, drawn.seed, False, drawn.scene))
    seen = [scene.render(k) for k in range(drawn.frames)]
    poses = np.stack([frame.T_wc for frame in seen])
    camera = scene.camera
    pinhole = camera.fx, camera.fy, camera.cx, camera.cy
    return Clip([f.image for f in seen], [], np.array([f.time for f in seen]), poses, pinhole)


def filmed(clip: Clip, drawn: Drawn) -> Clip:
    """The clip as a camera would keep it: exposure that swings three times, and JPEG."""
    turns = np.linspace(0, 6 * np.pi, len(clip.pictures))
    gains = 1 + drawn.swing * np.sin(turns + drawn.seed)
    return replace(
        clip,
        pictures=[
            _kept(picture, float(gain), drawn.jpeg)
            for picture, gain in zip(clip.pictures, gains, strict=True)
        ],
    )


def _kept(picture: Image, gain: float, quality: int) -> Image:
    exposed = np.clip(np.rint(picture * gain), 0, 255).astype(np.uint8)
    if not quality:
        return exposed
    _, data = cv2.imencode(".jpg", exposed, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def main(argv: Sequence[str] | None = None) -> None:
    """Write the clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the clips that these are made of")
    parser.add_argument("out", type=Path, help="folder to write, not there yet")
    parser.add_argument("--count", type=int, default=8, help="how many clips (8)")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(argv)
    if asked.out.exists():
        raise SystemExit(f"{asked.out} is there already; name another folder")
    rng = np.random.default_rng(asked.seed)
    made = 0
    while made < asked.count:
        drawn = draw(rng)
        alone = still(asked.data, drawn)
        if alone is None:
            continue
        layers = [m.layer(asked.data, alone.size, len(alone.pictures)) for m in drawn.movers]
        clip = alone.under(layers)
        if not SHARE[0] <= clip.moving <= SHARE[1]:
            continue
        name = f"drawn{asked.seed}_{made}_{drawn.scene}"
        filmed(clip, drawn).write(asked.out / name)
        filmed(alone, drawn).write(asked.out / f"{name}_static")
        print(f"{name}: {len(clip.pictures)} pictures, {clip.moving:.0%} of them moves; {drawn}")
        made += 1


if __name__ == "__main__":
    main()
