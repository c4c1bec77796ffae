"""Views of the static point cloud, drawn with a depth buffer in numpy."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from droidw.slam.frame import RunResult
from droidw_plugins.observers._pictures import data_uri
from droidw_plugins.observers._truth import rotation

__all__ = ["cloud_views", "splat"]

Array = npt.NDArray[np.float64]
_SIZE = (720, 470)
_PATH_BGRA = (246, 130, 59, 255)

# Name, turn about the vertical and tilt from above, in degrees.
_VIEWS = (("from behind the camera", 14.0, 12.0), ("from above, to the side", -38.0, 42.0))


def cloud_views(result: RunResult, most: int) -> list[tuple[str, str, int, int]]:
    """Two views as (name, data URI, width, height); none for an empty cloud.

    The viewpoints circle the middle of the cloud, in the frame of the middle keyframe.
    """
    xyz = np.asarray(result.cloud.xyz, dtype=np.float64).reshape(-1, 3)
    rgb = np.asarray(result.cloud.rgb, dtype=np.uint8).reshape(-1, 3)
    if most < 1 or not len(xyz):
        return []
    if len(xyz) > most:
        # Drawn by chance, from a fixed seed: every n-th point would draw the columns of the grid.
        chosen = np.random.default_rng(0).integers(0, len(xyz), most)
        xyz, rgb = xyz[chosen], rgb[chosen]
    good = np.isfinite(xyz).all(axis=1)
    xyz, rgb = xyz[good], rgb[good]
    if not len(xyz):
        return []
    poses = np.array([k.T_wc for k in result.keyframes], dtype=np.float64).reshape(-1, 7)
    if not len(poses):
        poses = np.asarray(result.trajectory.T_wc, dtype=np.float64).reshape(-1, 7)
    poses = poses[np.isfinite(poses).all(axis=1)]
    if len(poses):
        middle = poses[len(poses) // 2]
        R_wc, origin = rotation(middle[3:]), middle[:3]
    else:
        R_wc, origin = np.eye(3), np.zeros(3)
    points = (xyz - origin) @ R_wc
    path = (poses[:, :3] - origin) @ R_wc
    target = np.median(points, axis=0)
    radius = float(np.percentile(np.linalg.norm(points - target, axis=1), 80)) or 1.0
    views = []
    for name, turn, tilt in _VIEWS:
        R, eye = _look(target, 2.1 * radius, turn, tilt)
        picture = splat((points - eye) @ R.T, rgb, _SIZE, 1.05 * _SIZE[0])
        _draw_path(picture, (path - eye) @ R.T, 1.05 * _SIZE[0], radius)
        views.append((name, data_uri(picture, ".png"), *_SIZE))
    return views


def splat(
    points: Array, rgb: npt.NDArray[np.uint8], size: tuple[int, int], focal: float
) -> npt.NDArray[np.uint8]:
    """Draw points [N,3] of a camera frame as a BGRA picture [H,W,4]; nearer ones hide others.

    Args:
        points: x right, y down, z forward.
        rgb: [N,3] colours.
        size: width and height in pixels.
        focal: focal length in pixels; the axis goes through the middle of the picture.
    """
    width, height = size
    z = points[:, 2]
    front = z > 1e-6
    points, rgb, z = points[front], rgb[front], z[front]
    x = np.floor(focal * points[:, 0] / z + width / 2)
    y = np.floor(focal * points[:, 1] / z + height / 2)
    inside = (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1)
    index = y[inside].astype(np.int64) * width + x[inside].astype(np.int64)
    z, rgb = z[inside], rgb[inside]
    order = np.argsort(-z, kind="stable")
    index, z, rgb = index[order], z[order], rgb[order]
    colour = np.zeros((height * width, 3), dtype=np.uint8)
    depth = np.full(height * width, np.inf)
    for step in (0, 1, width, width + 1):
        # From far to near: of several values for one pixel the last stays.
        one = np.full(height * width, np.inf)
        paint = np.zeros((height * width, 3), dtype=np.uint8)
        one[index + step] = z
        paint[index + step] = rgb
        nearer = one < depth
        depth[nearer], colour[nearer] = one[nearer], paint[nearer]
    depth_map, picture = depth.reshape(height, width), colour.reshape(height, width, 3)
    for _ in range(2):
        _fill(depth_map, picture)
    alpha = np.where(np.isfinite(depth_map), 255, 0).astype(np.uint8)
    return np.ascontiguousarray(np.dstack([picture[..., ::-1], alpha]))


def _fill(depth: Array, colour: npt.NDArray[np.uint8]) -> None:
    """Close holes: an empty pixel with three or more neighbours takes the nearest of them."""
    height, width = depth.shape
    padded = np.pad(depth, 1, constant_values=np.inf)
    tinted = np.pad(colour, ((1, 1), (1, 1), (0, 0)))
    best, paint = np.full_like(depth, np.inf), np.zeros_like(colour)
    count = np.zeros(depth.shape, dtype=np.int8)
    for dy in range(3):
        for dx in range(3):
            if (dy, dx) == (1, 1):
                continue
            other = padded[dy : dy + height, dx : dx + width]
            count += np.isfinite(other)
            nearer = other < best
            best[nearer] = other[nearer]
            paint[nearer] = tinted[dy : dy + height, dx : dx + width][nearer]
    empty = ~np.isfinite(depth) & (count >= 3)
    depth[empty], colour[empty] = best[empty], paint[empty]


def _look(target: Array, distance: float, turn: float, tilt: float) -> tuple[Array, Array]:
    """Rotation into the view's camera and its centre, looking at `target` from turn and tilt."""
    a, b = math.radians(turn), math.radians(tilt)
    forward = np.array([math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
    right = np.array([math.cos(a), 0.0, -math.sin(a)])
    down = np.cross(forward, right)
    return np.stack([right, down, forward]), target - distance * forward


def _draw_path(
    picture: npt.NDArray[np.uint8], path: Array, focal: float, radius: float
) -> None:
    near = path[:, 2] > 0.02 * radius
    if near.sum() < 1:
        return
    visible = path[near]
    x = focal * visible[:, 0] / visible[:, 2] + picture.shape[1] / 2
    y = focal * visible[:, 1] / visible[:, 2] + picture.shape[0] / 2
    pixels = np.clip(np.stack([x, y], axis=1), -5000, 5000).round().astype(np.int32)
    cv2.polylines(picture, [pixels.reshape(-1, 1, 2)], False, (255, 255, 255, 255), 5, cv2.LINE_AA)
    cv2.polylines(picture, [pixels.reshape(-1, 1, 2)], False, _PATH_BGRA, 3, cv2.LINE_AA)
    end = (int(pixels[-1, 0]), int(pixels[-1, 1]))
    cv2.circle(picture, end, 6, (255, 255, 255, 255), -1, cv2.LINE_AA)
    cv2.circle(picture, end, 4, _PATH_BGRA, -1, cv2.LINE_AA)
