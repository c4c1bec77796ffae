"""`droidw demo`: renders, runs and evaluates."""

from __future__ import annotations

import json

from droidw.cli.main import main
from droidw.io.tum import read_tum


def test_demo(tmp_path, capsys, monkeypatch):
    from droidw.cli import run
    from droidw.testing import scenes

    spec = scenes.SceneSpec
    # a quarter of the pixels, and one thread: the demo itself is the same
    monkeypatch.setattr(scenes, "SceneSpec", lambda **given: spec(width=160, height=120, **given))
    execute = run.execute

    def small(plugins, files, preset, overrides, *rest, **more):
        overrides = [*overrides, "threads=1", "camera.long_side=160", "frontend.warmup=4",
                     "motion_filter.threshold=0.4", "backend.passes=[1]"]  # fmt: skip
        return execute(plugins, files, preset, overrides, *rest, **more)

    monkeypatch.setattr(run, "execute", small)
    out = tmp_path / "demo"
    assert main(["demo", "-o", str(out), "--frames", "24"]) == 0
    said = capsys.readouterr().out
    assert "rendering 24 frames" in said
    assert "RMSE over 24 of 24 frames after Sim(3)" in said
    assert "motion mask: AUC" in said
    assert f"open {out}/run/report.html" in said
    assert len(read_tum(out / "run" / "trajectory.tum")) == 24
    assert json.loads((out / "run" / "metrics.json").read_text())["matched"] == 24
    for name in ("report.html", "points.ply", "manifest.json"):
        assert (out / "run" / name).is_file()
    # again into the same folder
    assert main(["demo", "-o", str(out), "--frames", "20"]) == 0
    assert len(read_tum(out / "run" / "trajectory.tum")) == 20


def test_too_short(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path / "demo"), "--frames", "5"]) == 2
    assert "too short to track" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()
