"""A made-up but consistent run: a textured room, a moving box, a camera that swings by."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from droidw.geometry.camera import Camera
from droidw.slam.frame import CloudPoints, KeyframeRecord, RunResult, Trajectory

W, H, STRIDE, OFFSET = 320, 240, 8, 3.5
F, CX, CY = 260.0, 159.5, 119.5


def poses(count: int) -> np.ndarray:
    """A camera that sways to the right and back, turning slightly, T_wc [N,7]."""
    s = np.linspace(0, 1, count)
    yaw = 0.25 * np.sin(2 * np.pi * s)
    t = np.stack([1.2 * np.sin(np.pi * s), 0.1 * np.sin(4 * np.pi * s), 1.4 * s**2], axis=1)
    q = np.stack([0 * s, np.sin(yaw / 2), 0 * s, np.cos(yaw / 2)], axis=1)
    return np.concatenate([t, q], axis=1)


def _picture(T_wc: np.ndarray, phase: float, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Image, depth and motion mask of a room 6 x 3 x 6 with a box that walks through it."""
    yaw = 2 * np.arctan2(T_wc[4], T_wc[6])
    R = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    x, y = np.meshgrid(np.arange(W), np.arange(H))
    rays = np.stack([(x - CX) / F, (y - CY) / F, np.ones_like(x, dtype=float)], -1) @ R.T
    best = np.full((H, W), np.inf)
    colour = np.zeros((H, W, 3))
    for axis, value, base in (
        (0, -3.0, (190, 150, 120)),
        (0, 3.0, (120, 150, 190)),
        (1, 1.4, (140, 120, 90)),
        (1, -1.6, (225, 225, 220)),
        (2, 5.0, (170, 190, 160)),
    ):
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (value - T_wc[axis]) / rays[..., axis]
        hit = T_wc[:3] + z[..., None] * rays
        checks = np.floor(hit * 1.5).sum(-1) % 2
        nearer = (z > 0) & (z < best)
        best = np.where(nearer, z, best)
        colour = np.where(
            nearer[..., None], np.array(base) * (0.75 + 0.25 * checks[..., None]), colour
        )
    left = int(40 + 190 * phase)
    mask = np.zeros((H, W), dtype=bool)
    mask[90:210, left : left + 50] = True
    colour[mask] = (200, 70, 60)
    best = np.where(mask, 1.6, best)
    noise = rng.normal(0, 5, colour.shape)
    return np.clip(colour + noise, 0, 255).astype(np.uint8), best, mask, R


def made_up_result(
    run_dir: Path,
    frames: int = 300,
    keyframes: int = 40,
    with_truth: bool = True,
    still: bool = False,
    manifest: dict | None = None,
    warnings: tuple[str, ...] = (),
    source: str = "/data/kitchen",
) -> RunResult:
    """A result with everything filled in; `still`: the camera does not move at all."""
    rng = np.random.default_rng(1)
    times = 1311868163.0 + np.arange(frames) / 30.0
    T_wc = poses(max(frames, 1))[:frames]
    if still:
        T_wc[:, :3] = rng.normal(0, 2e-4, (frames, 3))
        T_wc[:, 3:] = (0, 0, 0, 1)
    chosen = np.linspace(0, frames - 1, keyframes).round().astype(int) if frames else []
    records, xyz, rgb = [], [], []
    for i in chosen:
        image, depth, mask, R = _picture(T_wc[i], i / max(frames, 1), rng)
        ys, xs = np.mgrid[0 : H // STRIDE, 0 : W // STRIDE]
        px, py = (xs * STRIDE + OFFSET).round().astype(int), (ys * STRIDE + OFFSET).astype(int)
        grid = depth[py, px] * np.exp(rng.normal(0, 0.01, px.shape))
        moving = mask[py, px]
        u = np.where(moving, 2.0, 0.74) + rng.gamma(1.0, 0.06, px.shape)
        weight = np.clip(1 / np.maximum(45 * u - 35, 0.1), 0, 1)
        weight = np.where(moving, weight, np.maximum(weight, rng.uniform(0.6, 1, px.shape)))
        valid = ~moving & (rng.uniform(size=px.shape) > 0.08)
        records.append(
            KeyframeRecord(
                index=int(i),
                time=float(times[i]),
                name=f"{i:06d}.jpg",
                image=image,
                T_wc=T_wc[i],
                intrinsics=np.array([F, F, CX, CY]),
                disp=(1 / grid).astype(np.float32),
                depth_valid=valid,
                uncertainty=u.astype(np.float32),
                weight=weight.astype(np.float32),
            )
        )
        fine_y, fine_x = np.mgrid[0:H:3, 0:W:3]
        keep = ~mask[fine_y, fine_x]
        rays = np.stack([(fine_x - CX) / F, (fine_y - CY) / F, np.ones(fine_x.shape)], -1)
        points = T_wc[i, :3] + depth[fine_y, fine_x][..., None] * (rays @ R.T)
        xyz.append(points[keep])
        rgb.append(image[fine_y, fine_x][keep])
    cloud = CloudPoints(
        np.concatenate(xyz).astype(np.float32) if xyz else np.zeros((0, 3), np.float32),
        np.concatenate(rgb) if rgb else np.zeros((0, 3), np.uint8),
    )
    truth = None
    if with_truth:
        # Another frame, another scale, and a drift that the error chart must show.
        s = np.linspace(0, 1, frames)[:, None]
        drift = 0.02 * np.sin(7 * s) * [[1, 0.5, -1]] + rng.normal(0, 0.002, (frames, 3))
        turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
        centres = 0.7 * (T_wc[:, :3] + drift) @ turn.T + [3, -2, 1]
        truth = Trajectory(times, np.concatenate([centres, T_wc[:, 3:]], axis=1))
    return RunResult(
        trajectory=Trajectory(times, T_wc),
        keyframes=tuple(records),
        cloud=cloud,
        camera=Camera(W, H, F, F, CX, CY),
        stride=STRIDE,
        offset=OFFSET,
        source=source,
        truth=truth,
        manifest=manifest if manifest is not None else full_manifest(),
        warnings=warnings,
        run_dir=run_dir,
    )


def full_manifest() -> dict:
    """A manifest with every key that the report knows."""
    return {
        "frames": 300,
        "fps": 23.4,
        "peak_memory_mb": 812.3,
        "agreement": 0.874,
        "sweeps": 2,
        "preset": "cpu",
        "stages": {"decode": 1.2, "track": 8.4, "global": 2.1, "fill": 0.9, "export": 0.3},
        "camera": "from camera.txt: 640x480, fx 525.0, no distortion; reduced to 320x240.",
        "versions": {"droidw": "0.1.0", "python": "3.12.3", "torch": "2.13.0", "numpy": "2.3.1"},
        "seconds": 13.4,
        "note": "preset cpu: no GPU was found",
        "parts": {
            "features": {"name": "cnn", "from": "droidw 0.1.0", "reference": "EfficientNet"},
            "ba": {"name": "torch", "from": "droidw 0.1.0", "reference": "REFERENCE 3"},
        },
        "config_yaml": "input:\n  source: /data/kitchen\ncamera:\n  long_side: 320\n" * 4,
        "files": {"trajectory.tum": "pose of every frame"},
    }


@pytest.fixture(scope="session")
def make_result() -> Callable[..., RunResult]:
    """The function that makes a result; it takes the run folder and what to leave out."""
    return made_up_result
