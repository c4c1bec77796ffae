"""Rendered scenes that are no rooms, alone and with what moves over them, for `droidw ablate`.

A street that is driven along behind a car, a square that is walked over, a village seen from a
drone, shelves that are passed closely, and a track between hedges with a bend. Poses are exact.
Cars are boxes that stand on the ground and drive; the other movers are cut out of real footage, as
in `movers.py`.

    python benchmarks/scenery.py DATA OUT
    droidw run OUT/NAME --preset cpu threads=1

For each scene it writes OUT/NAME (static), and OUT/NAME_moving and others of SCENES with masks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import pi

import cv2
import numpy as np
import numpy.typing as npt
from unseen import Mover, folders
from variants import Clip, Size
from worlds import Path6, World, pose_at, shelves, square, street, track, village

from droidw.testing import _textures as textures
from droidw.testing._motion import Pose, quaternion
from droidw.testing._shapes import Body, Hits, cast
from droidw.testing.scenes import painted

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Made:
    """One of SCENES: how it is built, its pictures, and what is pasted over them, by clip.

    The clip of no movers is that of the cars of the scene itself.
    """

    build: Callable[[World], Path6]
    size: Size
    fps: float
    frames: int
    focal: float
    clips: Mapping[str, tuple[Mover, ...]]


_GOAT, _CAMEL = "composite_kitchen", "composite_hospital"  # and their dancers
_RUNNER, _CAR = "davis_parkour", "davis_car-roundabout"
SCENES = {
    "street": Made(
        street,
        (480, 270),
        12.0,
        140,
        0.8,
        {"moving": (), "car": (Mover(_CAR),), "goat": (Mover(_GOAT),)},
    ),
    "square": Made(
        square,
        (320, 240),
        15.0,
        160,
        0.75,
        {"moving": (Mover(_GOAT),), "camel": (Mover(_CAMEL, 1.3, 0.0, True, 20),)},
    ),
    "village": Made(
        village, (400, 300), 10.0, 120, 0.9, {"moving": (Mover(_CAMEL, 0.8, 0.1, True),)}
    ),
    "shelves": Made(
        shelves, (270, 360), 20.0, 150, 1.1, {"moving": (Mover(_RUNNER, 1.6), Mover(_CAR, 0.8))}
    ),
    "track": Made(
        track,
        (320, 180),
        15.0,
        140,
        0.7,
        {
            "moving": (Mover(_GOAT, 0.8, -0.1, True, 40),),
            "car": (Mover(_CAR, 0.8, 0.05, True),),
        },
    ),
}


class Renderer:
    """Pictures of a world, four rays a pixel, with the noise of a sensor."""

    def __init__(self, made: Made, seed: int) -> None:
        self.made = made
        self.world = World(np.random.default_rng([seed, 41]))
        self.camera = made.build(self.world)
        self.atlas = textures.Atlas.pack(self.world.tiles)
        rng = np.random.default_rng([seed, 43])
        clouds = textures.noise(rng, 512, 2048, 240, 5, 0.6)
        self.sky = np.array([168, 190, 216], np.float32) + 34 * np.clip(clouds, -0.2, 1)
        f = made.focal * max(made.size)
        self.intrinsics = np.array([f, f, (made.size[0] - 1) / 2, (made.size[1] - 1) / 2])

    def pose(self, k: int) -> Pose:
        """Camera to world."""
        return pose_at(self.camera, k / (self.made.frames - 1))

    def still(self) -> tuple[list[Body], list[Pose]]:
        """What stands still, and where."""
        there = [
            (body, pose_at(path, 0.0))
            for body, path in zip(self.world.bodies, self.world.paths, strict=True)
            if not body.actor
        ]
        return [body for body, _ in there], [pose for _, pose in there]

    def clearance(self) -> float:
        """How near the camera comes to what stands still, in metres along the optical axis."""
        width, height = self.made.size
        x, y = (a.ravel().astype(np.float32) for a in np.mgrid[:width:16, :height:16])
        bodies, poses = self.still()
        return min(
            float(cast(bodies, poses, self.pose(k), self.intrinsics, x, y).depth.min())
            for k in range(self.made.frames)
        )

    def render(self, k: int, moving: bool) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        """Picture number k [H,W,3], and what in it [H,W] moves."""
        width, height = self.made.size
        y, x = np.mgrid[: 2 * height, : 2 * width].astype(np.float32)
        x, y = (x.ravel() - 0.5) / 2, (y.ravel() - 0.5) / 2
        world, t = self.world, k / (self.made.frames - 1)
        there = [
            (body, path)
            for body, path in zip(world.bodies, world.paths, strict=True)
            if moving or not body.actor
        ]
        bodies = [body for body, _ in there]
        poses = [pose_at(path, t) for _, path in there]
        hits = cast(bodies, poses, self.pose(k), self.intrinsics, x, y)
        hits.body[~np.isfinite(hits.depth)] = -1
        colour = self._shade(bodies, hits, k, x, y).reshape(2 * height, 2 * width, 3)
        image = cv2.resize(colour, (width, height), interpolation=cv2.INTER_AREA)
        noise = np.random.default_rng([47, k]).standard_normal(image.shape, dtype=np.float32)
        actors = np.array([body.actor > 0 for body in bodies] + [False])[hits.body]
        share = actors.reshape(height, 2, width, 2).mean(axis=(1, 3))
        return np.clip(np.rint(image + 1.5 * noise), 0, 255).astype(np.uint8), share >= 0.5

    def _shade(self, bodies: list[Body], hits: Hits, k: int, x: Image, y: Image) -> Image:
        colour = painted(self.atlas, bodies, hits, self.intrinsics[0])
        above = hits.body < 0
        fx, fy, cx, cy = self.intrinsics
        rays = self.pose(k).R @ np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)])[:, above]
        turn = np.arctan2(rays[0], rays[2]) / (2 * pi) + 0.5
        rise = np.arctan2(-rays[1], np.hypot(rays[0], rays[2])) / (pi / 2)
        place = [(turn * 2047).astype(np.float32), ((1 - rise) * 511).astype(np.float32)]
        pad = -len(turn) % 4096
        maps = [np.pad(p, (0, pad)).reshape(-1, 4096) for p in place]
        if len(turn):
            sky = cv2.remap(self.sky, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            colour[above] = sky.reshape(-1, 3)[: len(turn)]
        return colour

    def clip(self, moving: bool = False) -> Clip:
        """All pictures, with masks where cars drive."""
        frames = range(self.made.frames)
        rendered = [self.render(k, moving) for k in frames]
        poses = map(self.pose, frames)
        rows = np.stack([np.concatenate([p.t, quaternion(p.R)]) for p in poses])
        fx, fy, cx, cy = map(float, self.intrinsics)
        times = np.round(np.arange(self.made.frames) / self.made.fps, 6)
        masks = [mask for _, mask in rendered] if moving else []
        return Clip([picture for picture, _ in rendered], masks, times, rows, (fx, fy, cx, cy))


def main(argv: Sequence[str] | None = None) -> None:
    """Write the clips."""
    data, out = folders(__doc__, argv)
    for seed, (name, made) in enumerate(SCENES.items()):
        renderer = Renderer(made, seed)
        still = renderer.clip()
        still.write(out / name)
        for of, movers in made.clips.items():
            layers = [mover.layer(data, made.size, made.frames) for mover in movers]
            clip = still.under(layers) if movers else renderer.clip(moving=True)
            clip.write(out / f"{name}_{of}")
            print(f"{name}_{of}: {len(clip.pictures)} pictures, {clip.moving:.0%} of them moves")


if __name__ == "__main__":
    main()
