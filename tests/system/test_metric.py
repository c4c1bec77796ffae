"""Metres from depth maps, with holes that are filled with next to nothing."""

from __future__ import annotations

import json

import numpy as np
import pytest

from droidw.testing.scenes import Scene, named_spec

COUNT = 20


def test_the_result_is_in_metres_whatever_fills_holes(go, tmp_path):
    scene, maps = Scene(named_spec("handheld-no-moving")), tmp_path / "maps"
    maps.mkdir()
    for k in range(COUNT):
        depth = np.array(scene.render(k).depth, np.float32)
        depth[40:64, 40:64] = 1e-8
        np.save(maps / f"{k:04d}.npy", depth)
    ran = go(
        "synthetic:handheld-no-moving", "--preset", "cpu", "depth=file",
        f"depth.options.path={maps}", f"input.max_frames={COUNT}", "uncertainty=none",
        "threads=1", "exporters=[trajectory]", "observers=null", quick=False,
    )  # fmt: skip
    assert ran.code == 0, ran.err
    assert ran.manifest["scale"] == "metric, from the depth prior"
    metrics = json.loads((ran.folder / "metrics.json").read_text())
    assert metrics["scale"] == pytest.approx(1.0, abs=0.005)
    assert "could not be solved" not in ran.warnings
