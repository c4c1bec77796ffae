"""Tiny footage, rendered once, and a run of the command on it with quick settings."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from droidw.cli.main import main
from droidw.io.tum import read_tum
from droidw.testing.scenes import Scene, SceneSpec

QUICK = (
    "camera.long_side=160", "threads=1", "features=none", "uncertainty=none",
    "exporters.uncertainty=null", "exporters.depth=null",
    "observers.report=null", "observers.progress=null",
    "motion_filter.threshold=0.4", "frontend.warmup=4",
    "schedule.init_blind.updates=3", "schedule.init.updates=3",
    "backend.passes=[1]", "filler.updates=1", "camera.refine_focal=false",
)  # fmt: skip
"""Everything on, but little of it: a run takes about half a second."""

FRAMES = {"handheld": 26, "rotation": 26, "static": 10}


@cache
def pictures(motion):
    """RGB pictures 160x120 of a synthetic room without moving objects."""
    scene = Scene(SceneSpec(160, 120, FRAMES[motion], moving=False, motion=motion))
    return [scene.render(k).image for k in range(len(scene))], scene


@pytest.fixture(scope="session")
def rendered():
    """motion -> (pictures, scene); rendered when asked for."""
    return pictures


class Footage(NamedTuple):
    """A folder of pictures and the times in its list."""

    folder: Path
    times: list[float]


@pytest.fixture
def footage(tmp_path):
    """Write a folder of pictures: `footage("handheld", count=20, blank=range(8, 10))`."""

    def write(
        motion="handheld", count=None, *, name="clip", times=None, blank=(), grey=90, calib=None
    ):
        images, scene = pictures(motion)
        images = images[:count]
        times = [k / 30 for k in range(len(images))] if times is None else times
        folder = tmp_path / name
        (folder / "rgb").mkdir(parents=True)
        lines = []
        for k, image in enumerate(images):
            shown = np.full_like(image, grey) if k in blank else image
            cv2.imwrite(str(folder / "rgb" / f"{k:04d}.png"), shown[..., ::-1])
            lines.append(f"{times[k]:.6f} rgb/{k:04d}.png")
        (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
        fx, fy, cx, cy = scene.intrinsics
        text = f"width 160\nheight 120\nfx {fx}\nfy {fy}\ncx {cx}\ncy {cy}\n"
        (folder / "camera.txt").write_text(text if calib is None else calib)
        return Footage(folder, times)

    return write


class Ran(NamedTuple):
    """What a run came to; fields are None where it left no such file."""

    code: int
    out: str
    err: str
    folder: Path
    manifest: dict | None

    @property
    def poses(self):
        """Times and poses of trajectory.tum, as floats row by row."""
        return np.loadtxt(self.folder / "trajectory.tum", ndmin=2)

    @property
    def warnings(self):
        """All warnings of the manifest as one text."""
        return "\n".join(self.manifest["warnings"])


@pytest.fixture
def go(tmp_path, capsys):
    """Run the command with quick settings: `go(source, "key=value", "--flag", to="out")`."""

    def run(source, *arguments, to="out", quick=True):
        folder = tmp_path / to
        given = [] if source is None else [str(source)]
        options = ["--preset", "cpu", *QUICK] if quick else []
        capsys.readouterr()
        code = main(["run", *given, "-o", str(folder), *options, *map(str, arguments)])
        said = capsys.readouterr()
        manifest = folder / "manifest.json"
        facts = json.loads(manifest.read_text()) if manifest.is_file() else None
        if (folder / "trajectory.tum").is_file():
            valid(folder / "trajectory.tum")
        return Ran(code, said.out, said.err, folder, facts)

    return run


def valid(path):
    """A trajectory that any tool can read: finite, rising times, unit quaternions."""
    trajectory = read_tum(path)
    assert np.isfinite(trajectory.T_wc).all()
    assert (np.diff(trajectory.times) > 0).all()
    assert np.allclose(np.linalg.norm(trajectory.T_wc[:, 3:], axis=1), 1.0, atol=1e-6)


@pytest.fixture(scope="session")
def quick():
    """The quick settings, for runs in a process of their own."""
    return ["--preset", "cpu", *QUICK]
