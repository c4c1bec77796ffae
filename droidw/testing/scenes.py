"""Synthetic footage with exact truth: a furnished room, a moving camera, moving objects.

Everything is ray-cast, so depth, poses, motion masks and correspondence are exact to rounding;
the pictures are anti-aliased and carry mild sensor noise. World axes are those of OpenCV (x
right, y down, z forward), metres and seconds. One `SceneSpec` always gives the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from droidw.errors import UsageError
from droidw.slam.frame import Trajectory
from droidw.testing import _textures as textures
from droidw.testing._motion import CAMERA_PATHS, Pose, actor_path, camera_path, quaternion
from droidw.testing._room import FLOOR, furnish
from droidw.testing._shapes import TEXEL, Body, Hits, cast, face_size

if TYPE_CHECKING:
    from droidw.geometry.camera import Camera

__all__ = [
    "MOTIONS",
    "SCENES",
    "Correspondences",
    "Scene",
    "SceneFrame",
    "SceneSpec",
    "named_spec",
]

Floats = npt.NDArray[np.float64]

MOTIONS = tuple(CAMERA_PATHS)
"""Camera paths: handheld, orbit, forward, rotation (about the centre), static."""

SCENES: dict[str, tuple[str, bool]] = {
    **{motion: (motion, True) for motion in MOTIONS},
    "no-moving": ("handheld", False),
    **{f"{motion}-no-moving": (motion, False) for motion in MOTIONS},
}
"""Scenes by name: the camera path, and whether objects move."""


@dataclass(frozen=True)
class SceneSpec:
    """What to render; equal specs give equal bytes.

    Attributes:
        width, height: pixels, at least 16.
        frames: number of pictures; fps: pictures per second.
        seed: of room, textures, paths and noise.
        moving: whether a walking box and a bouncing ball are there (10 to 25 % of the pixels).
        motion: camera path, one of `MOTIONS`.
        noise: standard deviation of the sensor noise in grey levels.
        focal: focal length in units of the width.
    """

    width: int = 320
    height: int = 240
    frames: int = 60
    fps: float = 30.0
    seed: int = 0
    moving: bool = True
    motion: str = "handheld"
    noise: float = 1.5
    focal: float = 0.82

    def __post_init__(self) -> None:
        if self.motion not in CAMERA_PATHS:
            raise UsageError(
                f"scene: motion '{self.motion}' is not known", "available: " + ", ".join(MOTIONS)
            )
        if self.width < 16 or self.height < 16:
            raise UsageError(
                f"scene: size {self.width}x{self.height} is too small", "use at least 16x16 pixels"
            )
        if self.frames < 1 or self.fps <= 0 or self.seed < 0 or self.noise < 0 or self.focal <= 0:
            raise UsageError(
                "scene: frames >= 1, fps > 0, seed >= 0, noise >= 0 and focal > 0 are needed, got "
                f"frames={self.frames}, fps={self.fps}, seed={self.seed}, noise={self.noise}, "
                f"focal={self.focal}"
            )


def named_spec(
    name: str,
    *,
    width: int = 320,
    height: int = 240,
    frames: int = 60,
    fps: float = 30.0,
    seed: int = 0,
    noise: float = 1.5,
) -> SceneSpec:
    """The spec of a scene in `SCENES`, such as "handheld" or "orbit-no-moving".

    Raises:
        UsageError: there is no such scene, or a number is impossible.
    """
    if name not in SCENES:
        raise UsageError(f"there is no synthetic scene '{name}'", "available: " + ", ".join(SCENES))
    motion, moving = SCENES[name]
    return SceneSpec(width, height, frames, fps, seed, moving, motion, noise)


@dataclass(frozen=True)
class SceneFrame:
    """One picture and its truth.

    Attributes:
        index, time: position and time in seconds.
        image: [H,W,3] uint8 RGB.
        depth: [H,W] float32, along the optical axis at pixel centres, metres.
        T_wc: [7] float64, camera to world, translation then unit quaternion xyzw.
        moving: [H,W] bool, pixels whose centre shows a moving object.
    """

    index: int
    time: float
    image: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    T_wc: Floats
    moving: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Correspondences:
    """Where surface points seen in one frame lie in another.

    Attributes:
        target: [...,2] float64 pixels x, y in frame j; finite everywhere (a point that is behind
            camera j keeps its place in i).
        visible: [...] bool, in front of camera j, inside its picture and not hidden there.
        moving: [...] bool, the point belongs to a moving object and moved with it.
    """

    target: Floats
    visible: npt.NDArray[np.bool_]
    moving: npt.NDArray[np.bool_]


class Scene:
    """A synthetic sequence; frames can be rendered in any order.

    Args:
        spec: what to render; the default is a hand-held camera with moving objects.
    """

    def __init__(self, spec: SceneSpec | None = None) -> None:
        self.spec = spec or SceneSpec()
        rng = np.random.default_rng([self.spec.seed, 17])
        self._phases = rng.uniform(0, 2 * np.pi, 13)
        self._actor_phases = rng.uniform(0, 2 * np.pi, (2, 3))
        self._bodies, self._rest = furnish(rng, self.spec.moving)

    @cached_property
    def _atlas(self) -> textures.Atlas:
        rng = np.random.default_rng([self.spec.seed, 23])
        tiles: list[textures.Image] = []
        for body in self._bodies:
            sizes = [face_size(body.half, face) for face in range(6)]
            if body.kind == "room":
                paints = [
                    textures.wall,
                    textures.wall,
                    textures.plain,
                    textures.planks,
                    textures.wall,
                    textures.wall,
                ]
                tiles += [paint(rng, h, w) for paint, (h, w) in zip(paints, sizes, strict=True)]
            else:
                paint = textures.fabric if body.actor else textures.furniture
                tiles += textures.paint_box(paint, rng, sizes)
        return textures.Atlas.pack(tiles)

    def __len__(self) -> int:
        return self.spec.frames

    @property
    def intrinsics(self) -> Floats:
        """fx, fy, cx, cy in pixels; pixel centres at integers."""
        spec = self.spec
        f = spec.focal * spec.width
        return np.array([f, f, (spec.width - 1) / 2, (spec.height - 1) / 2])

    @property
    def camera(self) -> Camera:
        """The calibration."""
        from droidw.geometry.camera import Camera

        fx, fy, cx, cy = (float(v) for v in self.intrinsics)
        return Camera(self.spec.width, self.spec.height, fx, fy, cx, cy)

    def time(self, index: int) -> float:
        """Seconds since the first frame."""
        return index / self.spec.fps

    def T_wc(self, index: int) -> Floats:
        """Camera to world [7] of a frame: translation, then unit quaternion xyzw.

        Raises:
            UsageError: there is no such frame.
        """
        self._check(index)
        pose = self._camera_pose(index)
        return np.concatenate([pose.t, quaternion(pose.R)])

    @property
    def trajectory(self) -> Trajectory:
        """True poses of all frames."""
        indices = range(len(self))
        return Trajectory(
            np.array([self.time(k) for k in indices], dtype=np.float64),
            np.stack([self.T_wc(k) for k in indices]),
        )

    def render(self, index: int) -> SceneFrame:
        """Picture and truth of one frame.

        Raises:
            UsageError: there is no such frame.
        """
        spec = self.spec
        self._check(index)
        y, x = np.mgrid[: spec.height, : spec.width].astype(np.float64)
        truth = self._cast(index, x.ravel(), y.ravel())
        # Four rays a pixel at the quarter points; a box filter over them is the anti-aliasing.
        fine_y, fine_x = np.mgrid[: 2 * spec.height, : 2 * spec.width].astype(np.float32)
        fine = self._cast(index, (fine_x.ravel() - 0.5) / 2, (fine_y.ravel() - 0.5) / 2)
        colour = self._shade(fine).reshape(2 * spec.height, 2 * spec.width, 3)
        image = np.asarray(
            cv2.resize(colour, (spec.width, spec.height), interpolation=cv2.INTER_AREA)
        )
        if spec.noise > 0:
            rng = np.random.default_rng([spec.seed, 29, index])
            image = image + spec.noise * rng.standard_normal(image.shape, dtype=np.float32)
        shape = spec.height, spec.width
        return SceneFrame(
            index,
            self.time(index),
            np.clip(np.rint(image), 0, 255).astype(np.uint8),
            truth.depth.reshape(shape).astype(np.float32),
            self.T_wc(index),
            self._actors(truth).reshape(shape) > 0,
        )

    def depth_at(self, index: int, pixels: Floats) -> Floats:
        """Exact depth [...] in metres at pixel positions [...,2] of a frame."""
        flat = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        return np.asarray(
            self._cast(index, flat[:, 0], flat[:, 1]).depth, dtype=np.float64
        ).reshape(pixels.shape[:-1])

    def correspond(self, i: int, j: int, pixels: Floats) -> Correspondences:
        """Where the surface points at `pixels` [...,2] of frame i lie in frame j.

        Points of moving objects move with their object. A point counts as visible where a ray
        through its place in j meets the same surface at the same depth.
        """
        self._check(i)
        self._check(j)
        flat = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        hits = self._cast(i, flat[:, 0], flat[:, 1])
        camera, poses = self._camera_pose(j), self._poses(j)
        fx, fy, cx, cy = self.intrinsics
        X_c = np.zeros((3, len(flat)))
        for number in np.unique(hits.body):
            chosen = np.flatnonzero(hits.body == number)
            pose = poses[number]
            X_w = pose.R @ hits.point[:, chosen] + pose.t[:, None]
            X_c[:, chosen] = camera.R.T @ (X_w - camera.t[:, None])
        front = X_c[2] > 1e-3
        z = np.where(front, X_c[2], 1.0)
        target = np.stack([fx * X_c[0] / z + cx, fy * X_c[1] / z + cy], axis=-1)
        target = np.where(front[:, None], target, flat)
        inside = ((target >= 0) & (target <= [self.spec.width - 1, self.spec.height - 1])).all(-1)
        there = self._cast(j, target[:, 0], target[:, 1])
        visible = front & inside & (np.abs(there.depth - z) < 1e-4 * z)
        shape = pixels.shape[:-1]
        return Correspondences(
            target.reshape(*shape, 2),
            visible.reshape(shape),
            (self._actors(hits) > 0).reshape(shape),
        )

    def flow(self, i: int, j: int) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """For every pixel of i: its place in j [H,W,2] in pixels, and whether it is visible."""
        y, x = np.mgrid[: self.spec.height, : self.spec.width].astype(np.float64)
        found = self.correspond(i, j, np.stack([x, y], axis=-1))
        return found.target, found.visible

    def write(self, folder: Path) -> None:
        """Write the sequence as a folder of pictures with its truth.

        `rgb/*.png` and `rgb.txt`, `camera.txt` (width height fx fy cx cy), `groundtruth.txt`
        (TUM, camera to world), `mask/*.png` (255: moving), `depth/*.png` (16 bit, millimetres).
        """
        from droidw.testing._folder import write_scene

        write_scene(self, folder)

    def _check(self, index: int) -> None:
        if not 0 <= index < len(self):
            raise UsageError(
                f"scene: there is no frame {index}", f"frames go from 0 to {len(self) - 1}"
            )

    def _camera_pose(self, index: int) -> Pose:
        return camera_path(self.spec.motion, self.time(index), self._phases)

    def _poses(self, index: int) -> list[Pose]:
        """Where the bodies are in a frame, body to world."""
        poses = []
        for body, rest in zip(self._bodies, self._rest, strict=True):
            if body.actor:
                kind = "ball" if body.kind == "ball" else "walker"
                rest = actor_path(
                    kind,
                    self.time(index),
                    self._actor_phases[body.actor - 1],
                    float(2 * body.half[1]),
                    FLOOR,
                )
            poses.append(rest)
        return poses

    def _cast(self, index: int, x: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> Hits:
        return cast(
            self._bodies, self._poses(index), self._camera_pose(index), self.intrinsics, x, y
        )

    def _actors(self, hits: Hits) -> npt.NDArray[np.int64]:
        """[N] number of the moving object that was hit, 0 for what is static."""
        return np.array([body.actor for body in self._bodies], dtype=np.int64)[hits.body]

    def _shade(self, hits: Hits) -> npt.NDArray[np.float32]:
        """Colours [N,3] of hits that came from two rays a pixel in each direction."""
        return painted(self._atlas, self._bodies, hits, self.intrinsics[0])


def painted(
    atlas: textures.Atlas, bodies: list[Body], hits: Hits, focal: np.float64
) -> npt.NDArray[np.float32]:
    """Colours [N,3] of hits of bodies whose faces are in the atlas, two rays a pixel each way.

    Where nothing was hit (`body` is -1) they mean nothing.

    Args:
        focal: focal length in pixels.
    """
    x, y = np.zeros(len(hits.depth), np.float32), np.zeros(len(hits.depth), np.float32)
    for number, body in enumerate(bodies):
        chosen = np.flatnonzero(hits.body == number)
        if len(chosen) == 0:
            continue
        face = hits.face[chosen].astype(np.intp)
        u, v = body.texel(hits.point[:, chosen], face)
        origin = atlas.origins[body.first_tile + face]
        x[chosen], y[chosen] = u + origin[:, 0], v + origin[:, 1]
    footprint = hits.depth / (2 * focal * TEXEL)
    # Between the short and the long side of the slanted footprint.
    level = np.log2(np.maximum(footprint, 1e-3)) - 0.5 * np.log2(np.maximum(hits.slant, 0.05))
    return atlas.sample(x, y, level.astype(np.float32))
