"""What stands in the room of the synthetic scenes."""

from __future__ import annotations

import numpy as np

from droidw.testing._motion import Pose, rotation
from droidw.testing._shapes import Body

__all__ = ["CEILING", "FLOOR", "furnish"]

FLOOR, CEILING = 1.2, -1.6
"""Height of floor and ceiling in the world, metres, y down."""


def furnish(rng: np.random.Generator, moving: bool) -> tuple[list[Body], list[Pose]]:
    """The room, its furniture and the actors; poses of actors are placeholders."""
    bodies: list[Body] = []
    poses: list[Pose] = []

    def add(
        kind: str,
        size: tuple[float, float, float],
        centre: tuple[float, float, float],
        yaw: float = 0.0,
        actor: int = 0,
    ) -> None:
        bodies.append(Body(kind, np.array(size) / 2, 6 * len(bodies), actor))
        poses.append(Pose(rotation(yaw, 0.0, 0.0), np.array(centre)))

    def vary(value: float, by: float) -> float:
        return float(value + rng.uniform(-by, by))

    add("room", (5.2, FLOOR - CEILING, 6.4), (0.0, (FLOOR + CEILING) / 2, 0.4))
    for x, z, width, height, depth in (
        (-1.6, 2.3, 0.9, 0.8, 0.7),
        (1.7, 2.7, 0.7, 1.9, 0.5),
        (0.3, 2.5, 0.7, 0.45, 0.5),
        (-0.7, 3.1, 0.5, 1.3, 0.4),
        (-2.1, 0.9, 0.5, 1.2, 0.5),
        (2.0, 1.3, 0.6, 0.7, 0.6),
    ):
        tall = vary(height, 0.1)
        wide, left, back = vary(width, 0.1), vary(x, 0.15), vary(z, 0.1)
        add("box", (wide, tall, depth), (left, FLOOR - tall / 2, back), vary(0.0, 0.5))
    add("box", (0.3, 0.3, 0.3), (vary(0.9, 0.2), vary(-0.9, 0.15), vary(2.3, 0.3)), vary(0.4, 0.4))
    if moving:
        add("box", (0.52, 1.5, 0.36), (0.0, 0.0, 1.0), actor=1)
        add("ball", (0.56, 0.56, 0.56), (0.0, 0.0, 1.0), actor=2)
    return bodies, poses
