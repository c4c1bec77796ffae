"""Analytic ray casting against a room, boxes and balls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from droidw.testing._motion import Pose

Array = npt.NDArray[np.floating[Any]]
Whole = npt.NDArray[np.integer[Any]]

__all__ = ["TEXEL", "UV_AXES", "Body", "Hits", "face_size"]

TEXEL = 0.008
"""Edge of a texel in metres."""

UV_AXES = ((2, 1), (0, 2), (0, 1))
"""For a face with its normal along axis a: the axes of its texture's x and y."""


def face_size(half: Array, face: int) -> tuple[int, int]:
    """Height and width in texels of face `2 * axis + (1 if the positive side)`."""
    u, v = UV_AXES[face // 2]
    return (
        max(8, int(np.ceil(2 * half[v] / TEXEL)) + 1),
        max(8, int(np.ceil(2 * half[u] / TEXEL)) + 1),
    )


@dataclass(frozen=True)
class Body:
    """A room seen from inside, a box or a ball, centred on its own origin.

    Attributes:
        kind: "room", "box" or "ball".
        half: [3] half extents in metres; a ball has its radius in all three.
        first_tile: number of its first face in the atlas.
        actor: 0 for a static body, 1 and up for the moving ones.
    """

    kind: str
    half: npt.NDArray[np.float64]
    first_tile: int
    actor: int = 0

    @property
    def radius(self) -> float:
        """Of a ball around the origin that holds the body."""
        return float(self.half[0] if self.kind == "ball" else np.linalg.norm(self.half))

    def intersect(self, origin: Array, rays: Array) -> tuple[Array, Whole]:
        """Nearest hit in front: parameter t [N] (inf where missed) and face [N] (int).

        Args:
            origin: [3]; rays: [3,N], both in the body's coordinates.
        """
        if self.kind == "ball":
            return self._ball(origin, rays)
        half = self.half.astype(rays.dtype)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / rays
        ahead = rays > 0
        edge = np.where(ahead, half[:, None], -half[:, None]) - origin[:, None]
        far = np.where(rays == 0, np.inf, edge * inverse)
        if self.kind == "room":
            axis = np.argmin(far, axis=0)
            return _pick(far, axis), 2 * axis + _pick(ahead, axis)
        near = (np.where(ahead, -half[:, None], half[:, None]) - origin[:, None]) * inverse
        near = np.where(
            rays == 0, np.where(np.abs(origin)[:, None] < half[:, None], -np.inf, np.inf), near
        )
        axis = np.argmax(near, axis=0)
        enter = _pick(near, axis)
        hit = (enter < far.min(axis=0)) & (enter > 0)
        return np.where(hit, enter, np.inf), 2 * axis + ~_pick(ahead, axis)

    def _ball(self, origin: Array, rays: Array) -> tuple[Array, Whole]:
        a = (rays * rays).sum(axis=0)
        b = (rays * origin[:, None]).sum(axis=0)
        c = float(origin @ origin) - float(self.half[0]) ** 2
        inside = b * b - a * c
        t = (-b - np.sqrt(np.maximum(inside, 0))) / a
        t = np.where((inside > 0) & (t > 0), t, np.inf)
        point = origin[:, None] + np.where(np.isfinite(t), t, 0) * rays
        axis = np.argmax(np.abs(point), axis=0)
        face = 2 * axis + (_pick(point, axis) > 0)
        return t, face

    def texel(self, point: Array, face: Whole) -> tuple[Array, Array]:
        """Texture coordinates [N] x, y of surface points [3,N] in the body's coordinates."""
        axis = face // 2
        if self.kind == "ball":
            # As if blown up onto its cube; the texture is as large as the cube's face.
            longest = np.abs(_pick(point, axis))
            point = point / longest * self.half[0].astype(point.dtype)
        table = np.array(UV_AXES)
        shifted = (point + self.half.astype(point.dtype)[:, None]) / TEXEL
        return _pick(shifted, table[axis, 0]), _pick(shifted, table[axis, 1])


def _pick(rows: npt.NDArray[Any], which: Whole) -> npt.NDArray[Any]:
    """Entry `which[n]` of every column n of [3,N]; faster than `take_along_axis`."""
    return np.asarray(np.where(which == 0, rows[0], np.where(which == 1, rows[1], rows[2])))


@dataclass
class Hits:
    """Nearest hits of N rays; a ray is `origin + depth * ray` with ray z = 1 in the camera.

    Attributes:
        depth: [N] along the optical axis, metres; inf where nothing was hit.
        body: [N] number of the body, -1 where nothing was hit.
        face: [N] face of the body.
        point: [3,N] in the body's own coordinates.
        slant: [N] cosine between ray and face normal, for prefiltering.
    """

    depth: Array
    body: npt.NDArray[np.int16]
    face: npt.NDArray[np.int16]
    point: Array
    slant: Array


def cast(
    bodies: list[Body], poses: list[Pose], camera: Pose, intrinsics: Array, x: Array, y: Array
) -> Hits:
    """Cast rays through pixel positions x, y [N] (pixel centres at integers).

    Args:
        bodies, poses: what is there and where it is (body to world).
        camera: camera to world. intrinsics: [4] fx fy cx cy.
    """
    dtype = x.dtype
    fx, fy, cx, cy = (dtype.type(v) for v in intrinsics)
    rays_c = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)])
    length = np.sqrt(rays_c[0] ** 2 + rays_c[1] ** 2 + 1)
    count = len(x)
    hits = Hits(
        np.full(count, np.inf, dtype),
        np.full(count, -1, np.int16),
        np.zeros(count, np.int16),
        np.zeros((3, count), dtype),
        np.ones(count, dtype),
    )
    for number, (body, pose) in enumerate(zip(bodies, poses, strict=True)):
        chosen = _candidates(body, pose, camera, intrinsics, x, y)
        if chosen is not None and len(chosen) == 0:
            continue
        turn = (pose.R.T @ camera.R).astype(dtype)
        origin = (pose.R.T @ (camera.t - pose.t)).astype(dtype)
        rays = turn @ (rays_c if chosen is None else rays_c[:, chosen])
        t, face = body.intersect(origin, rays)
        target: Whole | slice
        if number == 0 and chosen is None:  # the room: hit by all, and nothing was before it
            target = slice(None)
        else:
            closer = np.flatnonzero(t < (hits.depth if chosen is None else hits.depth[chosen]))
            if len(closer) == 0:
                continue
            target = closer if chosen is None else chosen[closer]
            t, face, rays = t[closer], face[closer], rays[:, closer]
        point = origin[:, None] + t * rays
        if body.kind == "ball":
            slant = np.abs((point * rays).sum(axis=0)) / dtype.type(body.half[0])
        else:
            slant = np.abs(_pick(rays, face // 2))
        hits.depth[target], hits.body[target], hits.face[target] = t, number, face
        hits.point[:, target], hits.slant[target] = point, slant / length[target]
    return hits


def _candidates(
    body: Body, pose: Pose, camera: Pose, intrinsics: Array, x: Array, y: Array
) -> npt.NDArray[np.intp] | None:
    """Rays that may hit the body: those in the projected cube of its bounding ball; None: all."""
    if body.kind == "room":
        return None
    centre = camera.R.T @ (pose.t - camera.t)
    r = body.radius
    if centre[2] + r <= 0:
        return np.zeros(0, np.intp)
    if centre[2] - r < 0.05:
        return None
    fx, fy, cx, cy = intrinsics
    spans = []
    for c, f, p in ((centre[0], fx, cx), (centre[1], fy, cy)):
        ends = [
            f * (c + side * r) / (centre[2] + depth * r) + p
            for side in (-1, 1)
            for depth in (-1, 1)
        ]
        spans.append((min(ends), max(ends)))
    (left, right), (top, bottom) = spans
    return np.flatnonzero((x >= left) & (x <= right) & (y >= top) & (y <= bottom))
