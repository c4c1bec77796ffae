"""Smooth paths of cameras and of moving objects, as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

__all__ = ["CAMERA_PATHS", "Pose", "actor_path", "camera_path", "quaternion"]


@dataclass(frozen=True)
class Pose:
    """A rigid pose: `R` [3,3] and `t` [3] map local coordinates to the world, X_w = R X + t."""

    R: Array
    t: Array


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """Rotation by roll about z, then pitch about x, then yaw about y (down), radians."""
    cy, sy, cp, sp, cr, sr = cos(yaw), sin(yaw), cos(pitch), sin(pitch), cos(roll), sin(roll)
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=np.float64)
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]], dtype=np.float64)
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]], dtype=np.float64)
    return about_y @ about_x @ about_z


def quaternion(R: Array) -> Array:
    """Unit quaternion xyzw (w >= 0) of a rotation matrix [3,3].

    The largest of the four components is taken from the diagonal, so that nothing is divided
    by a small number.
    """
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    squares = np.array([R[0, 0], R[1, 1], R[2, 2], trace]) * 2 + 1 - trace
    squares[3] = 1 + trace
    largest = int(np.argmax(squares))
    q = np.empty(4)
    if largest == 3:
        q[:3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        q[3] = squares[3]
    else:
        a, b, c = largest, (largest + 1) % 3, (largest + 2) % 3
        q[a] = squares[a]
        q[b] = R[b, a] + R[a, b]
        q[c] = R[c, a] + R[a, c]
        q[3] = R[c, b] - R[b, c]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0 else -q


def _wave(t: float, amplitude: float, hertz: float, phase: float) -> float:
    return amplitude * sin(2 * pi * hertz * t + phase)


def _shake(t: float, phases: Array) -> tuple[Array, Array]:
    """Tremor of a hand: metres [3], radians [3]."""
    metres = np.array([_wave(t, 0.005, 1.3 + 0.4 * k, phases[k]) for k in range(3)])
    radians = np.array([_wave(t, 0.004, 1.1 + 0.5 * k, phases[k + 3]) for k in range(3)])
    return metres, radians


def _handheld(t: float, phases: Array) -> Pose:
    shift, turn = _shake(t, phases)
    centre = np.array(
        [
            _wave(t, 0.60, 0.17, phases[6]) + _wave(t, 0.10, 0.43, phases[7]),
            _wave(t, 0.16, 0.29, phases[8]) - 0.05,
            _wave(t, 0.35, 0.13, phases[9]) - 1.05,
        ]
    )
    # The camera looks at a point that wanders, so rotation partly follows translation.
    yaw = -0.16 * centre[0] + _wave(t, 0.16, 0.19, phases[10])
    pitch = 0.04 + _wave(t, 0.06, 0.23, phases[11])
    roll = _wave(t, 0.04, 0.31, phases[12])
    return Pose(rotation(yaw + turn[0], pitch + turn[1], roll + turn[2]), centre + shift)


def _orbit(t: float, phases: Array) -> Pose:
    angle = _wave(t, 0.42, 0.11, phases[6])
    radius = 3.0 + _wave(t, 0.15, 0.17, phases[7])
    centre = np.array(
        [-radius * sin(angle), _wave(t, 0.15, 0.21, phases[8]), 1.9 - radius * cos(angle)]
    )
    return Pose(rotation(angle, 0.06 - 0.2 * centre[1], 0.0), centre)


def _forward(t: float, phases: Array) -> Pose:
    shift, turn = _shake(t, phases)
    centre = np.array([0.1 * sin(0.7 * t), 0.0, -1.25 - 0.55 * cos(0.6 * t)])
    return Pose(rotation(*turn), centre + shift)


def _rotation(t: float, phases: Array) -> Pose:
    yaw = _wave(t, 0.35, 0.12, phases[6])
    return Pose(
        rotation(yaw, 0.04 + _wave(t, 0.08, 0.2, phases[7]), _wave(t, 0.05, 0.26, 0)),
        np.array([0.0, -0.05, -1.0]),
    )


def _static(t: float, phases: Array) -> Pose:
    return Pose(rotation(0.0, 0.04, 0.0), np.array([0.0, -0.05, -1.05]))


CAMERA_PATHS: dict[str, Callable[[float, Array], Pose]] = {
    "handheld": _handheld,
    "orbit": _orbit,
    "forward": _forward,
    "rotation": _rotation,
    "static": _static,
}


def camera_path(motion: str, t: float, phases: Array) -> Pose:
    """Camera to world at time `t` seconds; `phases` [13] radians come from the seed."""
    return CAMERA_PATHS[motion](t, phases)


def actor_path(kind: str, t: float, phases: Array, height: float, floor: float) -> Pose:
    """Object to world at time `t`: a "walker" that strides over the floor, or a "ball"."""
    if kind == "walker":
        centre = np.array(
            [
                _wave(t, 0.75, 0.21, phases[0]),
                floor - height / 2 - 0.03 * abs(sin(2 * pi * 0.9 * t)),
                1.05 + _wave(t, 0.25, 0.16, phases[1]),
            ]
        )
        return Pose(rotation(_wave(t, 0.7, 0.17, phases[2]), 0.0, _wave(t, 0.05, 0.9, 0)), centre)
    centre = np.array(
        [
            _wave(t, 0.70, 0.27, phases[0]),
            0.15 - 0.7 * abs(sin(2 * pi * 0.38 * t + phases[1])),
            0.85 + _wave(t, 0.2, 0.2, phases[2]),
        ]
    )
    return Pose(rotation(1.3 * t, 0.9 * t, 0.0), centre)
