"""The arithmetic of benchmarks/end_to_end.py, without a run."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture(scope="module")
def bench(load_benchmark):
    return load_benchmark("end_to_end")


def test_stages_that_nest_are_not_added(bench):
    stages = {"decode": 3.0, "frontend": 4.0, "bundle": 3.5, "global": 2.0}
    lines = bench.stage_table(stages, 10.0)
    between = next(line for line in lines if line.startswith("| between"))
    assert "| 4.00 | 40.0 % |" in between
    assert lines.index("| frontend | 4.00 | 40.0 % |") < lines.index("| bundle | 3.50 | 35.0 % |")
    assert lines[-1] == "| decode | 3.00 | 30.0 % |"


def _run_folder(folder, centres, depth):
    rows = np.zeros((len(centres), 8))
    rows[:, 0], rows[:, 1:4], rows[:, 7] = np.arange(len(centres)), centres, 1.0
    np.savetxt(folder / "trajectory.tum", rows)
    (folder / "depth").mkdir()
    np.savez(folder / "depth" / "depth.npz", depth=np.asarray(depth, dtype=np.float32))
    return folder


def test_drift_is_in_median_depths(bench, tmp_path):
    centres = [[1, 0, 0], [1, 0.3, 0.4], [1, 0.1, 0]]
    folder = _run_folder(tmp_path, centres, [[[0, 2, np.inf, 5, 9]]])
    assert bench.drift(folder) == pytest.approx(0.1)


def test_no_depth_is_no_figure(bench, tmp_path):
    assert bench.drift(_run_folder(tmp_path, [[0, 0, 0]], [[[0, 0]]])) is None


def _record(source, **more):
    return {
        "source": source, "ate": None, "drift": None, "exit_code": 0, "warnings": [],
        "frames": 9, "matched": 9, **more,
    }  # fmt: skip


def test_limits(bench):
    kitchen = bench.static_figure(_record("redkitchen_300", ate=0.0421))
    assert not kitchen["met"] and kitchen["value"] == 0.0421
    assert bench.static_figure(_record("tartanair_hospital", ate=0.03))["met"]
    assert not bench.static_figure(_record("tartanair_hospital"))["met"]


def test_a_camera_at_rest_needs_a_warning_and_exit_code_0(bench):
    good = _record("tripod_juggle.mp4", drift=0.0, warnings=["the camera did not move"])
    assert bench.static_figure(good)["met"]
    assert not bench.static_figure({**good, "warnings": ["camera: unknown"]})["met"]
    assert not bench.static_figure({**good, "exit_code": 4})["met"]
    assert not bench.static_figure({**good, "drift": 0.011})["met"]
