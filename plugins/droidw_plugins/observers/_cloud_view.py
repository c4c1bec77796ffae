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
_WHITE = (255, 255, 255, 255)

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
    # Far enough to see the cameras too, which stand outside of what they look at.
    reach = float(np.linalg.norm(path - target, axis=1).max()) if len(path) else 0.0
    distance = max(2.1 * radius, 1.3 * min(reach, 4 * radius))
    views = []
    for name, turn, tilt in _VIEWS:
        R, eye = _look(target, distance, turn, tilt)
        seen = (points - eye) @ R.T
        path_seen = (path - eye) @ R.T
        lens = _fitting_lens(seen, path_seen[path_seen[:, 2] > 0.2 * distance])
        picture = splat(seen, rgb, _SIZE, lens)
        _draw_path(picture, path_seen, lens, 0.2 * distance)
        views.append((name, data_uri(picture, ".png"), *_SIZE))
    return views


def splat(
    points: Array,
    rgb: npt.NDArray[np.uint8],
    size: tuple[int, int],
    lens: tuple[float, float, float],
) -> npt.NDArray[np.uint8]:
    """Draw points [N,3] of a camera frame as a BGRA picture [H,W,4]; nearer ones hide others.

    Args:
        points: x right, y down, z forward.
        rgb: [N,3] colours.
        size: width and height in pixels.
        lens: focal length and principal point in pixels: f, cx, cy.
    """
    width, height = size
    focal, cx, cy = lens
    z = points[:, 2]
    front = z > 1e-6
    points, rgb, z = points[front], rgb[front], z[front]
    x = np.floor(focal * points[:, 0] / z + cx)
    y = np.floor(focal * points[:, 1] / z + cy)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    index = y[inside].astype(np.int64) * width + x[inside].astype(np.int64)
    z, rgb = z[inside], rgb[inside]
    order = np.argsort(-z, kind="stable")
    # From far to near: of several points in one pixel the last stays.
    which = np.full(height * width, -1, dtype=np.int64)
    which[index[order]] = order
    depth = np.full(height * width, np.inf, dtype=np.float32)
    hit = which >= 0
    if not hit.any():
        return np.zeros((height, width, 4), dtype=np.uint8)
    depth[hit] = z[which[hit]]
    # Points grow until neighbours touch: a thin cloud is drawn with larger ones.
    grow = int(np.clip(math.ceil(1.2 * math.sqrt(width * height / hit.sum())), 2, 7))
    owner = _grow(depth.reshape(height, width), which.reshape(height, width), grow)
    shown = owner >= 0
    picture = np.zeros((height, width, 4), dtype=np.uint8)
    picture[shown, :3] = rgb[owner[shown]][:, ::-1]
    picture[shown, 3] = 255
    return picture


def _grow(
    depth: npt.NDArray[np.float32], which: npt.NDArray[np.int64], size: int
) -> npt.NDArray[np.int64]:
    """The point that shows in each pixel [H,W] when each covers `size` x `size`; -1 where none."""
    for axis in (0, 1):
        # A square is a row of columns: two passes of `size` steps instead of their product.
        best, owner = depth.copy(), which.copy()
        for shift in range(-(size // 2), size - size // 2):
            if shift == 0:
                continue
            away = [slice(None), slice(None)]
            here = [slice(None), slice(None)]
            away[axis] = slice(max(-shift, 0), depth.shape[axis] - max(shift, 0))
            here[axis] = slice(max(shift, 0), depth.shape[axis] - max(-shift, 0))
            source, goal = tuple(away), tuple(here)
            nearer = depth[source] < best[goal]
            best[goal] = np.where(nearer, depth[source], best[goal])
            owner[goal] = np.where(nearer, which[source], owner[goal])
        depth, which = best, owner
    return which


def _fitting_lens(points: Array, path: Array) -> tuple[float, float, float]:
    """f, cx, cy in pixels with which most points and the whole path fit the picture."""
    front = points[points[:, 2] > 1e-6]
    if not len(front):
        return float(_SIZE[0]), _SIZE[0] / 2, _SIZE[1] / 2
    low, high = np.percentile(front[:, :2] / front[:, 2:], [4, 96], axis=0)
    if len(path):
        rays = np.clip(path[:, :2] / path[:, 2:], -2.0, 2.0)
        low, high = np.minimum(low, rays.min(axis=0)), np.maximum(high, rays.max(axis=0))
    room = 0.94 * np.array(_SIZE) / np.maximum(high - low, 1e-6)
    focal = float(np.clip(room.min(), 0.3 * _SIZE[0], 4.0 * _SIZE[0]))
    cx, cy = np.array(_SIZE) / 2 - focal * (low + high) / 2
    return focal, float(cx), float(cy)


def _look(target: Array, distance: float, turn: float, tilt: float) -> tuple[Array, Array]:
    """Rotation into the view's camera and its centre, looking at `target` from turn and tilt."""
    a, b = math.radians(turn), math.radians(tilt)
    forward = np.array([math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
    right = np.array([math.cos(a), 0.0, -math.sin(a)])
    down = np.cross(forward, right)
    return np.stack([right, down, forward]), target - distance * forward


def _draw_path(
    picture: npt.NDArray[np.uint8], path: Array, lens: tuple[float, float, float], near: float
) -> None:
    focal, cx, cy = lens
    visible = path[path[:, 2] > near]
    if not len(visible):
        return
    x = focal * visible[:, 0] / visible[:, 2] + cx
    y = focal * visible[:, 1] / visible[:, 2] + cy
    pixels = np.clip(np.stack([x, y], axis=1), -5000, 5000).round().astype(np.int32)
    line = pixels.reshape(-1, 1, 2)
    end = (int(pixels[-1, 0]), int(pixels[-1, 1]))
    for colour, width in ((_WHITE, 2), (_PATH_BGRA, 0)):
        cv2.polylines(picture, [line], False, colour, 3 + width, cv2.LINE_AA)
        cv2.circle(picture, end, 4 + width, colour, -1, cv2.LINE_AA)
