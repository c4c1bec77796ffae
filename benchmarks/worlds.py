"""What stands and drives in the scenes of `scenery.py`, and how the camera goes through them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import cos, pi, sin

import cv2
import numpy as np
import numpy.typing as npt

from droidw.testing import _textures as textures
from droidw.testing._motion import Pose, rotation
from droidw.testing._shapes import Body, face_size

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


def pose_at(path: Path6, t: float) -> Pose:
    """Where it is at a time from 0 to 1, to the world."""
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
