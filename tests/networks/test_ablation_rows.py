"""Every row of every packaged ablation builds its parts and runs 20 pictures of a rendered clip.

The networks of preset `paper` have made-up weights, which track nothing: what is held is that no
row needs code, and that each ends with a trajectory.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from droidw.ablation.cells import make_cells
from droidw.ablation.plan import load_plan
from droidw.ablation.run import Means, run_ablation
from droidw.config.packaged import packaged_in
from droidw.io.tum import read_tum
from droidw.plugin.manager import load_plugins
from droidw.testing.scenes import Scene, SceneSpec
from droidw_plugins._made_up import write_made_up

FRAMES = 20
NETWORKS = ("droid", "fit3d", "dinov2-vits14-reg", "metric3d-vit-small")
SHORT = (
    "camera.size=[160,128]", "input.max_frames=20", "frontend.warmup=4", "backend.passes=[1]",
    "schedule.init_blind.updates=1", "schedule.init.updates=2", "schedule.window.updates=1",
    "schedule.window_kept.updates=1", "filler.updates=1", "device=cpu",
)  # fmt: skip
OF_PRESET = {
    "paper": (
        "motion_filter.force_every=3", "schedule.init_again.updates=0",
        "depth.options={variant: vit-small, size: [112, 140]}",
    ),
    "cpu": ("motion_filter.threshold=0.4",),
}  # fmt: skip


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip") / "clip"
    Scene(SceneSpec(width=160, height=128, frames=FRAMES)).write(folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", packaged_in("ablations"))
def test_every_row_runs(name, clip, tmp_path, monkeypatch):
    monkeypatch.setenv("DROIDW_WEIGHTS", str(write_made_up(tmp_path / "weights", NETWORKS)))
    plan = load_plan(name, data=clip.parent, sequences=[clip.name], seeds=[0])
    plan = replace(plan, measure=replace(plan.measure, masks_after=0))
    plugins = load_plugins([])
    cells, _ = make_cells(plan, plugins, (*SHORT, *OF_PRESET[plan.preset]))
    assert [cell.row for cell in cells] == list(plan.rows)
    table = run_ablation(plan, cells, tmp_path / "out", Means(jobs=2), lambda *_: None)
    failed = {cell.row: why for cell, why in table.failures()}
    if "ba-cuda" in failed:
        assert "no GPU visible" in failed.pop("ba-cuda")
    assert failed == {}
    for cell, outcome in table.cells:
        if outcome is not None:
            folder = tmp_path / "out" / "cells" / cell.row / clip.name / "seed-0" / "run"
            assert len(read_tum(folder / "trajectory.tum")) == FRAMES, cell.row
            assert outcome.metrics["matched"] == FRAMES
