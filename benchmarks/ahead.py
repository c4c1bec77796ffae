"""Rendered drives behind something that goes ahead at a steady distance, for `droidw ablate`.

What keeps its distance looks like something far away, and no two pictures contradict that. Boxes on
the ground and in scenes of `scenery.py`, with exact poses; one is seen in reverse, by a camera that
looks back at what follows it.

    python benchmarks/ahead.py OUT
    droidw run OUT/NAME_moving --preset cpu threads=1

For each of DRIVES it writes OUT/NAME (static) and OUT/NAME_moving with masks.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import sin
from pathlib import Path

from scenery import SCENES, Renderer
from worlds import Path6, World

from droidw.testing import _textures as textures


@dataclass(frozen=True)
class Drive:
    """A scene, and the box that goes ahead in it: its size, its distance, and how that sways."""

    scene: str
    seed: int
    size: tuple[float, float, float]
    distance: float
    sway: float = 0.0
    back: bool = False


DRIVES: Mapping[str, Drive] = {
    "van": Drive("street", 12, (0.5, 0.42, 0.7), 1.4, 0.2),
    "lorry": Drive("street", 13, (0.75, 0.7, 1.2), 1.9, 0.1),
    "car": Drive("street", 14, (0.36, 0.26, 0.6), 0.95),
    "followed": Drive("street", 15, (0.5, 0.42, 0.7), 1.3, 0.15, back=True),
    "waggon": Drive("track", 16, (0.5, 0.5, 0.7), 1.0, 0.1),
}


def behind(drive: Drive) -> Callable[[World], Path6]:
    """How the scene is built, with nothing that moves in it but the box ahead."""
    build = SCENES[drive.scene].build

    def made(world: World) -> Path6:
        camera = build(world)
        still = [k for k, body in enumerate(world.bodies) if not body.actor]
        world.bodies = [world.bodies[k] for k in still]
        world.paths = [world.paths[k] for k in still]
        ahead = drive.distance / _length(camera)

        def before(t: float) -> tuple[float, float, float, float, float, float]:
            x, _, z, yaw, *_ = camera(t + ahead * (1 + drive.sway * sin(7 * t)))
            return x, -drive.size[1] / 2, z, yaw, 0.0, 0.0

        world.box(textures.fabric, drive.size, before, actor=1)
        return camera

    return made


def _length(path: Path6) -> float:
    """How far a path leads on the ground, from its first to its last picture."""
    (x, _, z, *_), (u, _, w, *_) = path(0.0), path(1.0)
    return float(((x - u) ** 2 + (z - w) ** 2) ** 0.5)


def main(argv: Sequence[str] | None = None) -> None:
    """Write the clips."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="folder to write, not there yet")
    out = parser.parse_args(argv).out
    if out.exists():
        raise SystemExit(f"{out} is there already; name another folder")
    for name, drive in DRIVES.items():
        renderer = Renderer(replace(SCENES[drive.scene], build=behind(drive)), drive.seed)
        for of, moving in ((name, False), (f"{name}_moving", True)):
            clip = renderer.clip(moving=moving)
            clip = clip.reversed() if drive.back else clip
            clip.write(out / of)
            print(f"{of}: {len(clip.pictures)} pictures, {clip.moving:.0%} of them moves")


if __name__ == "__main__":
    main()
