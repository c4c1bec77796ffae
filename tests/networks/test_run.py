"""A run with the paper's single-picture networks, stand-in weights and a reduced picture."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from droidw.cli.main import main
from droidw.testing.scenes import Scene, SceneSpec

QUICK = (
    "--preset", "cpu", "camera.long_side=80", "threads=1", "input.max_frames=8",
    "observers.report=null", "observers.progress=null",
    "exporters.uncertainty=null", "exporters.depth=null",
    "motion_filter.threshold=0.4", "frontend.warmup=4",
    "schedule.init_blind.updates=2", "schedule.init.updates=2",
    "backend.passes=[1]", "filler.updates=1",
)  # fmt: skip


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    folder = tmp_path_factory.mktemp("footage") / "clip"
    Scene(SceneSpec(width=160, height=120, frames=26, moving=False)).write(folder)
    return folder


def scale_of(facts):
    """The value of "scale", wherever in the manifest it stands."""
    if "scale" in facts:
        return facts["scale"]
    inner = (scale_of(value) for value in facts.values() if isinstance(value, dict))
    return next((found for found in inner if found), "")


@pytest.mark.parametrize("compat", [False, True])
def test_a_run_with_fit3d_and_metric3d(compat, footage, checkpoint, tmp_path, monkeypatch):
    """Parts know the raw camera, keyframes keep half precision, and the manifest says metric."""
    seen = {}
    from droidw.graph.store import KeyframeStore
    from droidw_plugins.depth._metric3d import Metric3dDepth

    append, predict = KeyframeStore.append, Metric3dDepth.predict

    def appended(self, info, **values):
        seen["features"] = values["features"].dtype, self["features"].dtype
        return append(self, info, **values)

    def predicted(self, frame):
        seen["factor"] = self._factor
        seen["fx"] = float(frame.intrinsics[0])
        found = predict(self, frame)
        seen["depth"] = found.depth
        return found

    monkeypatch.setattr(KeyframeStore, "append", appended)
    monkeypatch.setattr(Metric3dDepth, "predict", predicted)
    code = main(
        [
            "run", str(footage), "-o", str(tmp_path / "run"), *QUICK,
            "features=fit3d", f"features.options.weights={checkpoint('fit3d')}",
            "depth=metric3d", "depth.options.variant=vit-small", "depth.options.size=[56,84]",
            f"depth.options.weights={checkpoint('metric3d-vit-small')}",
            *(["compat=[droid-w]"] if compat else []),
        ]
    )  # fmt: skip
    assert code == 0
    raw = float((footage / "camera.txt").read_text().split("fx")[1].split()[0])
    assert seen["fx"] == pytest.approx(raw / 2)  # 160 pixels wide, worked on at 80
    assert seen["factor"] == (pytest.approx(raw / 1000) if compat else None)
    assert seen["features"] == (torch.float16, torch.float16)
    assert torch.isfinite(seen["depth"]).all() and seen["depth"].max() > 0
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert scale_of(manifest).startswith("arbitrary" if compat else "metric")
    trajectory = np.loadtxt(tmp_path / "run" / "trajectory.tum")
    assert trajectory.shape == (8, 8) and np.isfinite(trajectory).all()


def test_missing_weights_are_named_before_anything_is_read(footage, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("DROIDW_WEIGHTS", str(tmp_path / "empty"))
    code = main(
        ["run", str(footage), "-o", str(tmp_path / "run"), *QUICK, "features=fit3d",
         "depth=metric3d", "depth.options.variant=vit-small"]
    )  # fmt: skip
    said = capsys.readouterr().err
    assert code == 5 and not (tmp_path / "run").exists()
    assert "its weights 'fit3d' are not in" in said
    assert "its weights 'metric3d-vit-small' are not in" in said
    assert "droidw weights fetch fit3d" in said
