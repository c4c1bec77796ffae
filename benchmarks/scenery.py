"""Rendered scenes that are no rooms, alone and with what moves over them, for `droidw ablate`.

A street that is driven along behind a car, a square that is walked over, a village seen from a
drone, shelves that are passed closely, and a track between hedges with a bend. Poses are exact.
Cars are boxes that stand on the ground and drive; the other movers are cut out of real footage, as
in `movers.py`.

    python benchmarks/scenery.py DATA OUT
    droidw run OUT/NAME_moving --preset cpu threads=1

For each scene it writes OUT/NAME (static) and OUT/NAME_moving with masks.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import cos, pi, sin
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from unseen import Mover
from variants import Clip, Size

from droidw.testing import _textures as textures
from droidw.testing._motion import Pose, quaternion, rotation
from droidw.testing._shapes import TEXEL, Body, Hits, cast, face_size

Floats = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
Paint = Callable[[np.random.Generator, int, int], Image]
Path6 = Callable[[float], tuple[float, float, float, float, float, float]]
"""From 0 (first picture) to 1 (last): x, y (down), z (forward), yaw, pitch, roll."""


def facade(rng: np.random.Generator, height: int, width: int) -> Image:
    """Plaster with windows in rows, some of them lit, ledges and stains."""
    image = np.empty((height, width, 3), np.float32)
    image[:] = rng.uniform(90, 200) + rng.uniform(-30, 30, 3)
    image += 30 * textures.noise(rng, height, width, 60, 5, 0.75)
    storey, bay = int(rng.integers(38, 60)), int(rng.integers(30, 52))
    for y in range(8, height - storey // 2, storey):
        image[y : y + 2] *= 0.7
        for x in range(6, width - bay // 2, bay):
            h, w = int(storey * rng.uniform(0.45, 0.6)), int(bay * rng.uniform(0.4, 0.6))
            pane = image[y + 8 : y + 8 + h, x : x + w]
            pane[:] = rng.uniform(20, 110) + rng.uniform(-15, 15, 3)
            pane += 40 * textures.noise(rng, *pane.shape[:2], 12, 3)
            pane[:, pane.shape[1] // 2 : pane.shape[1] // 2 + 2] += 70
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), np.float32)


def asphalt(rng: np.random.Generator, height: int, width: int) -> Image:
    """Grey and rough, with patches, cracks and a dashed line in the middle."""
    image = np.empty((height, width, 3), np.float32)
    image[:] = rng.uniform(85, 125)
    image += 22 * textures.noise(rng, height, width, 90, 3)
    image += 26 * textures.noise(rng, height, width, 7, 3, 0.9)
    for _ in range(height * width // 30000):
        y, x = int(rng.integers(height)), int(rng.integers(width))
        image[y : y + int(rng.integers(8, 60)), x : x + int(rng.integers(8, 60))] -= 14
    for y in range(0, height, 90):
        image[y : y + 45, width // 2 - 2 : width // 2 + 3] = 210
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), np.float32)


def grass(rng: np.random.Generator, height: int, width: int) -> Image:
    """Green to brown at all scales."""
    tone = textures.noise(rng, height, width, 260, 8, 0.72)
    image = np.array([96, 112, 62], np.float32) + tone * (70, 62, 48)
    image += 22 * textures.noise(rng, height, width, 40, 4, 0.7, 3)
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8), np.float32)


def hedge(rng: np.random.Generator, height: int, width: int) -> Image:
    """Leaves: dark and bright at small scales."""
    tone = textures.noise(rng, height, width, 40, 5, 0.9)
    image = np.array([62, 84, 44], np.float32) + tone * (84, 92, 56)
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8), np.float32)


@dataclass
class World:
    """Boxes on the ground (y = 0, y down) below a sky, and what drives between them."""

    rng: np.random.Generator
    bodies: list[Body] = field(default_factory=list)
    paths: list[Path6] = field(default_factory=list)
    tiles: list[Image] = field(default_factory=list)

    def box(
        self, paint: Paint, size: Sequence[float], path: Path6 | Sequence[float], actor: int = 0
    ) -> None:
        """A box that stands at x, z with a yaw, or drives: `path` gives where its middle is."""
        half = np.asarray(size, np.float64) / 2
        body = Body("box", half, len(self.tiles), actor)
        if not callable(path):
            x, z, yaw = path
            path = _still(x, -float(half[1]), z, yaw)
        self.bodies.append(body)
        self.paths.append(path)
        self.tiles += textures.paint_box(paint, self.rng, [face_size(half, f) for f in range(6)])

    def ground(self, paint: Paint, width: float, length: float, z: float) -> None:
        """A slab whose upper side is the ground from -width/2 to width/2 around z."""
        self.box(paint, (width, 0.1, length), _still(0.0, 0.05, z, 0.0))


def _still(x: float, y: float, z: float, yaw: float) -> Path6:
    return lambda t: (x, y, z, yaw, 0.0, 0.0)


def _pose(path: Path6, t: float) -> Pose:
    x, y, z, yaw, pitch, roll = path(t)
    return Pose(rotation(yaw, pitch, roll), np.array([x, y, z]))


def street(world: World) -> Path6:
    """Along a street behind a car, at a height of a third of a storey, with a slight bend."""
    world.ground(asphalt, 6.0, 18.0, 7.0)
    for side in (-1, 1):
        z = -1.5
        while z < 15:
            depth, high = world.rng.uniform(0.9, 1.8), world.rng.uniform(0.8, 2.0)
            x = side * (1.25 + 0.4 + world.rng.uniform(0, 0.15))
            world.box(facade, (0.8, high, depth), (x, z + depth / 2, 0.0))
            z += depth + (0.0 if world.rng.random() < 0.7 else 0.3)
        for z in np.arange(0.0, 13.0, 1.6):
            parked = (0.3, 0.26, 0.7), (side * 1.0, z + world.rng.uniform(0, 0.5), 0.0)
            world.box(textures.furniture, *parked)
    world.box(facade, (6.0, 2.2, 0.5), (0.0, 16.0, 0.0))

    def drive(t: float, ahead: float = 0.0) -> tuple[float, float, float, float, float, float]:
        z = 8.0 * t + ahead
        x = 0.25 * sin(0.5 * z)
        return x, -0.3, z, 0.125 * cos(0.5 * z), 0.03 * sin(9 * t), 0.01 * sin(7 * t)

    def before(t: float) -> tuple[float, float, float, float, float, float]:
        x, _, z, yaw, *_ = drive(t, 1.35 + 0.25 * sin(5 * t))
        return x + 0.05, -0.22, z, yaw, 0.0, 0.0

    def oncoming(t: float) -> tuple[float, float, float, float, float, float]:
        return -0.55, -0.15, 14.0 - 12.0 * t, 0.0, 0.0, 0.0

    world.box(textures.fabric, (0.5, 0.42, 0.7), before, actor=1)
    world.box(textures.furniture, (0.32, 0.3, 0.7), oncoming, actor=2)
    return drive


def square(world: World) -> Path6:
    """Half around a fountain on a paved square with houses, hand-held."""
    world.ground(textures.planks, 8.0, 8.0, 0.0)
    for k in range(14):
        angle = 2 * pi * k / 14
        size = (1.3, world.rng.uniform(1.0, 2.2), 0.8)
        world.box(facade, size, (3.2 * sin(angle), 3.2 * cos(angle), angle))
    world.box(textures.wall, (0.5, 0.9, 0.5), (0.1, 0.2, 0.4))
    for _ in range(9):
        x, z = world.rng.uniform(-2.2, 2.2, 2)
        if x * x + z * z < 2.6:
            size = world.rng.uniform(0.15, 0.5, 3)
            world.box(textures.furniture, size, (x, z, world.rng.uniform(0, 3)))

    def walk(t: float) -> tuple[float, float, float, float, float, float]:
        angle = 2.2 * t - 1.0
        step = 2 * pi * 9 * t
        x, z = 1.9 * sin(angle), -1.9 * cos(angle)
        return (
            x + 0.012 * sin(step / 2),
            -0.42 + 0.012 * sin(step),
            z,
            -angle + 0.25 * sin(6 * t),
            0.02 * sin(8 * t) + 0.01 * sin(step),
            0.03 * sin(5 * t),
        )

    return walk


def village(world: World) -> Path6:
    """From above and aslant: houses and hedges on a meadow, the drone flies a bow."""
    world.ground(grass, 14.0, 14.0, 0.0)
    for _ in range(34):
        x, z = world.rng.uniform(-4.5, 4.5, 2)
        size = world.rng.uniform((0.3, 0.2, 0.3), (1.0, 0.7, 1.0))
        paint = (facade, hedge, textures.furniture)[int(world.rng.integers(3))]
        world.box(paint, size, (x, z, world.rng.uniform(0, pi)))

    def fly(t: float) -> tuple[float, float, float, float, float, float]:
        angle = 1.4 * t
        return (
            3.0 * sin(angle) - 1.5,
            -2.4 - 0.5 * t,
            3.5 * t - 4.2,
            0.5 * sin(4 * t),
            -0.75 + 0.1 * sin(5 * t),
            0.12 * sin(3 * t),
        )

    return fly


def shelves(world: World) -> Path6:
    """Past shelves that are an arm's length away, in a corridor."""
    world.ground(textures.planks, 6.0, 9.0, 0.0)
    world.box(textures.wall, (6.0, 2.4, 0.1), (0.0, 1.3, 0.0))
    for x in np.arange(-2.6, 2.6, 0.55):
        for y in (-0.15, -0.7, -1.25, -1.8):
            size = world.rng.uniform((0.3, 0.2, 0.15), (0.5, 0.5, 0.5))
            z = 1.2 - size[2] / 2
            world.box(textures.furniture, size, _still(x, y, z, world.rng.uniform(-0.1, 0.1)))

    def pass_by(t: float) -> tuple[float, float, float, float, float, float]:
        return (
            2.4 * t - 1.2,
            -1.0 + 0.12 * sin(6 * t),
            0.08 * sin(5 * t),
            0.2 * sin(7 * t),
            0.06 * sin(9 * t),
            0.05 * sin(4 * t),
        )

    return pass_by


def track(world: World) -> Path6:
    """Between hedges on a meadow, into a bend, with trees of two boxes."""
    world.ground(grass, 16.0, 16.0, 3.0)

    def middle(z: float) -> float:
        return 0.12 * z * z

    for z in np.arange(-1.5, 6.5, 0.55):
        yaw = np.arctan(0.24 * z)
        for side in (-1, 1):
            x = middle(z) + side * (0.9 + world.rng.uniform(0, 0.3))
            size = world.rng.uniform((0.25, 0.3, 0.5), (0.5, 0.7, 0.7))
            world.box(hedge, size, (x, z, yaw))
            if world.rng.random() < 0.35:
                at = x + side * world.rng.uniform(0.5, 1.2), z
                world.box(textures.planks, (0.12, 1.0, 0.12), (*at, 0.3))
                crown = world.rng.uniform(0.5, 0.9, 3)
                world.box(hedge, crown, _still(at[0], -1.2, at[1], world.rng.uniform(0, 3)))

    def ride(t: float) -> tuple[float, float, float, float, float, float]:
        z = 4.5 * t - 0.8
        bump = 0.012 * sin(60 * t) + 0.008 * sin(97 * t)
        return middle(z), -0.35 + bump, z, float(np.arctan(0.24 * z)), 0.5 * bump, 0.4 * bump

    return ride


@dataclass(frozen=True)
class Made:
    """One of SCENES: how it is built, its pictures, and what is pasted over them."""

    build: Callable[[World], Path6]
    size: Size
    fps: float
    frames: int
    focal: float
    movers: tuple[Mover, ...]


_GOAT, _CAMEL = "composite_kitchen", "composite_hospital"  # and their dancers
_RUNNER, _CAR = "davis_parkour", "davis_car-roundabout"
SCENES = {
    "street": Made(street, (480, 270), 12.0, 140, 0.8, ()),
    "square": Made(square, (320, 240), 15.0, 160, 0.75, (Mover(_GOAT),)),
    "village": Made(village, (400, 300), 10.0, 120, 0.9, (Mover(_CAMEL, 0.8, 0.1, True),)),
    "shelves": Made(shelves, (270, 360), 20.0, 150, 1.1, (Mover(_RUNNER, 1.6), Mover(_CAR, 0.8))),
    "track": Made(track, (320, 180), 15.0, 140, 0.7, (Mover(_GOAT, 0.8, -0.1, True, 40),)),
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
        return _pose(self.camera, k / (self.made.frames - 1))

    def render(self, k: int, moving: bool) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        """Picture number k [H,W,3], and what in it [H,W] moves."""
        width, height = self.made.size
        y, x = np.mgrid[: 2 * height, : 2 * width].astype(np.float32)
        x, y = (x.ravel() - 0.5) / 2, (y.ravel() - 0.5) / 2
        there = [
            b for b in range(len(self.world.bodies)) if moving or not self.world.bodies[b].actor
        ]
        bodies = [self.world.bodies[b] for b in there]
        t = k / (self.made.frames - 1)
        poses = [_pose(self.world.paths[b], t) for b in there]
        hits = cast(bodies, poses, self.pose(k), self.intrinsics, x, y)
        hits.body[~np.isfinite(hits.depth)] = -1
        colour = self._shade(bodies, hits, k, x, y).reshape(2 * height, 2 * width, 3)
        image = cv2.resize(colour, (width, height), interpolation=cv2.INTER_AREA)
        noise = np.random.default_rng([47, k]).standard_normal(image.shape, dtype=np.float32)
        actors = np.array([body.actor > 0 for body in bodies] + [False])[hits.body]
        share = actors.reshape(height, 2, width, 2).mean(axis=(1, 3))
        return np.clip(np.rint(image + 1.5 * noise), 0, 255).astype(np.uint8), share >= 0.5

    def _shade(self, bodies: list[Body], hits: Hits, k: int, x: Image, y: Image) -> Image:
        u, v = np.zeros_like(x), np.zeros_like(x)
        for number, body in enumerate(bodies):
            chosen = np.flatnonzero(hits.body == number)
            if len(chosen) == 0:
                continue
            face = hits.face[chosen].astype(np.intp)
            across, down = body.texel(hits.point[:, chosen], face)
            origin = self.atlas.origins[body.first_tile + face]
            u[chosen], v[chosen] = across + origin[:, 0], down + origin[:, 1]
        above = hits.body < 0
        depth = np.where(above, 1.0, hits.depth)
        level = np.log2(depth / (2 * self.intrinsics[0] * TEXEL))
        level -= 0.5 * np.log2(np.maximum(hits.slant, 0.05))
        colour = self.atlas.sample(u, v, level.astype(np.float32))
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

    def clip(self, data: Path, moving: bool) -> Clip:
        """All pictures, with masks where anything moves."""
        made = self.made
        rendered = [self.render(k, moving) for k in range(made.frames)]
        poses = [self.pose(k) for k in range(made.frames)]
        rows = np.stack([np.concatenate([p.t, quaternion(p.R)]) for p in poses])
        fx, fy, cx, cy = map(float, self.intrinsics)
        times = np.round(np.arange(made.frames) / made.fps, 6)
        clip = Clip([p for p, _ in rendered], [], times, rows, (fx, fy, cx, cy))
        if not moving:
            return clip
        layers = [mover.layer(data, made.size, made.frames) for mover in made.movers]
        pasted = clip.under(layers)
        masks = [a | b for (_, a), b in zip(rendered, pasted.masks, strict=True)]
        return Clip(pasted.pictures, masks, times, rows, (fx, fy, cx, cy))


def main(argv: Sequence[str] | None = None) -> None:
    """Write the clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of clips with masks")
    parser.add_argument("out", type=Path, help="folder to write, not there yet")
    asked = parser.parse_args(argv)
    if asked.out.exists():
        raise SystemExit(f"{asked.out} is there already; name another folder")
    for seed, (name, made) in enumerate(SCENES.items()):
        renderer = Renderer(made, seed)
        for moving in (False, True):
            clip = renderer.clip(asked.data, moving)
            clip.write(asked.out / (name + "_moving" * moving))
        print(f"{name}: {len(clip.pictures)} pictures, {clip.moving:.0%} of them moves")


if __name__ == "__main__":
    main()
