"""Short runs of the whole system on a tiny clip, with weights made up by a rule."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from droidw.cli.main import main
from droidw.io.tum import read_tum
from droidw.testing.pretend_gpu import PretendGpu
from droidw.testing.scenes import Scene, SceneSpec
from droidw_plugins._made_up import write_made_up

WEIGHTS = ("droid", "fit3d", "dinov2-vits14-reg", "metric3d-vit-small")
QUICK = (
    "exporters={trajectory: {}}", "observers.report=null", "observers.progress=null", "threads=1",
    "motion_filter.force_every=2", "frontend.warmup=4", "frontend.max_factors=12",
    "frontend.keyframe_threshold=0", "frontend.starts=false", "frontend.redundant=newest",
    "frontend.unknown_moves=1", "filler.updates=1", "backend.passes=[1]",
    "camera.refine_focal=false",
    "schedule.init_blind.updates=1", "schedule.init.updates=1", "schedule.init_again.updates=0",
    "schedule.window.updates=1", "schedule.window_kept.updates=1",
)  # fmt: skip
COUNT = 13


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    """13 pictures of 96x64 with something that moves, and their depth."""
    folder = tmp_path_factory.mktemp("clip") / "clip"
    Scene(SceneSpec(width=96, height=64, frames=COUNT, fps=10.0, motion="handheld")).write(folder)
    return folder


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    return write_made_up(tmp_path_factory.mktemp("weights"), WEIGHTS)


@pytest.fixture
def go(clip, weights, tmp_path, monkeypatch, capsys):
    """Run on a device: `go(device, *arguments)` -> (exit code, stderr, centres [N,3]).

    What is in `arguments` overrules `QUICK`, and what is in `after` both.
    """
    monkeypatch.setenv("DROIDW_WEIGHTS", str(weights))

    def call(device, *arguments, source=None, after=()):
        out = tmp_path / device.replace(":", "")
        code = main(
            ["run", source or str(clip), "-o", str(out), "--overwrite", "--device", device,
             *QUICK, *arguments, *after]
        )  # fmt: skip
        wrong = capsys.readouterr().err
        assert "Traceback" not in wrong, wrong
        centres = read_tum(out / "trajectory.tum").T_wc[:, :3] if code == 0 else np.zeros((0, 3))
        return code, wrong, centres

    return call


@pytest.fixture
def gpu():
    with PretendGpu() as pretended:
        yield pretended


@pytest.fixture
def either(go):
    """Centres on the CPU and on the pretended GPU, and that GPU: `either(*arguments)`."""

    def call(*arguments, source=None, pretend=True):
        found = []
        for device in ("cpu", "cuda"):
            with PretendGpu() if device == "cuda" and pretend else nullcontext() as gpu:
                code, wrong, centres = go(device, *arguments, source=source)
            assert code == 0, wrong
            found.append(centres)
        return (*found, gpu)

    return call
