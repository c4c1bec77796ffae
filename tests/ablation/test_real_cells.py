"""Cells that are runs, as processes and as tasks of a local Ray: one table."""

from __future__ import annotations

import json
import signal
import socket
from types import SimpleNamespace

import pytest

from droidw.ablation import on_ray
from droidw.ablation.cells import Cell, make_cells
from droidw.ablation.on_ray import run_on_ray
from droidw.ablation.plan import load_plan
from droidw.ablation.run import Means, run_ablation
from droidw.cli.main import main
from droidw.errors import DroidwError, MissingRequirementError
from droidw.plugin.manager import load_plugins

PLAN = """
title: A row and a broken one
preset: cpu
seeds: [0]
sequences: {room: {source: "synthetic:handheld"}}
base:
  device: cpu
  reader: {name: synthetic, options: {frames: 20, width: 160, height: 120}}
  camera: {long_side: 160}
  motion_filter: {threshold: 0.4}
  frontend: {warmup: 4}
  schedule: {init_blind: {updates: 2}, init: {updates: 2}}
  backend: {passes: [1]}
  filler: {updates: 1}
rows:
  full: {features: none, uncertainty: none}
  broken: {features: none, uncertainty: none, ba: breaks}
columns: [ate_rmse, keyframes.ate_rmse, fps]
"""

PLUGIN = '''
"""A backend that raises, and an observer that kills the worker of Ray which runs its cell, once."""
import os
import signal
from dataclasses import dataclass, field
from pathlib import Path

import droidw


@dataclass(frozen=True)
class Marker:
    path: str = field(default="", metadata={"help": "is made before the worker is killed"})


class Breaks:
    def step(self, problem):
        raise RuntimeError("no step today")


class Killer:
    def __init__(self, path):
        self.path = Path(path)

    def on_event(self, event):
        worker = os.getppid()
        if "ray::" in Path(f"/proc/{worker}/cmdline").read_text() and not self.path.exists():
            self.path.write_text(str(worker))
            os.kill(worker, signal.SIGKILL)


both = frozenset({"cpu", "cuda"})


@droidw.hookimpl
def droidw_ba_backends():
    yield droidw.Component("breaks", "raises", lambda o, c: Breaks(), capabilities=both)


@droidw.hookimpl
def droidw_observers():
    yield droidw.Component("killer", "kills", lambda o, c: Killer(o.path), Marker)
'''


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The plan and the plugin, as files."""
    place = tmp_path_factory.mktemp("ablation")
    (place / "plan.yaml").write_text(PLAN)
    (place / "breaks.py").write_text(PLUGIN)
    return place


def run(files, out, *overrides, rows=(), **means):
    plan = load_plan(str(files / "plan.yaml"), rows=rows)
    plugin = files / "breaks.py"
    plugins = load_plugins([plugin], environ={"DROIDW_LOAD_PLUGINS": ""})
    cells, _ = make_cells(plan, plugins, overrides)
    chosen = Means(plugin_files=(str(plugin),), **means)
    return run_ablation(plan, cells, files / out, chosen, lambda *_: None)


@pytest.fixture(scope="module")
def local(files):
    """The table that local processes make."""
    return run(files, "local", jobs=2)


def test_a_cell_is_a_run(local, files):
    full, broken = (outcome for _, outcome in local.cells)
    assert not full.error
    assert broken.error == "RuntimeError: no step today"
    folder = files / "local" / "cells" / "full" / "room" / "seed-0"
    again = files / "again"
    assert main(["run", "--config", str(folder / "cell.yaml"), "-o", str(again)]) == 0
    poses = (folder / "run" / "trajectory.tum").read_bytes()
    assert poses == (again / "trajectory.tum").read_bytes()
    assert (folder / "run" / "manifest.json").is_file()
    # The figures are those of `droidw eval`.
    result = json.loads((folder / "result.json").read_text())
    assert result["metrics"]["matched"] == 20 and result["metrics"]["fps"] > 0
    assert result["metrics"]["keyframes.matched"] >= 4
    own = json.loads((folder / "run" / "metrics.json").read_text())
    assert result["metrics"]["ate_rmse"] == pytest.approx(own["ate_rmse"], rel=1e-4)
    assert len(result["curve"]["path"]) == 20
    page = (files / "local" / "report.html").read_text()
    assert "RuntimeError: no step today" in page and page.count("<svg") == 5
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")


def figures(table):
    """Everything but how long it took."""
    times = ("fps", "seconds", "peak_memory_mb")
    record = table.to_dict()["figures"]
    return {key: value for key, value in record.items() if key not in times}


def test_ray_makes_the_same_table_though_a_worker_is_killed(local, files):
    marker = files / "killed"
    handler = signal.getsignal(signal.SIGTERM)
    table = run(files, "ray", f"observers.killer={{path: {marker}}}", executor="ray", jobs=2)
    assert marker.exists()
    # Ray would take SIGTERM for itself, and finished cells would have no table.
    assert signal.getsignal(signal.SIGTERM) == handler
    assert figures(table) == figures(local) != {}
    assert [why for _, why in table.failures()] == [why for _, why in local.failures()]
    # And goes on as well: with local processes, nothing that is finished runs again.
    result = files / "ray" / "cells" / "full" / "room" / "seed-0" / "result.json"
    before = result.stat().st_mtime_ns
    more = run(files, "ray", f"observers.killer={{path: {marker}}}", rows=["full"])
    assert result.stat().st_mtime_ns == before and not more.failures()


def test_a_task_of_ray_that_fails_says_why(files, tmp_path):
    cell = make_cells(load_plan(str(files / "plan.yaml"), rows=["full"]), load_plugins())[0][0]
    told = []  # nothing was prepared in the folder, as where another machine does not see it
    run_on_ray([(cell, tmp_path)], lambda _, state, outcome: told.append((state, outcome)), 1)
    (_, running), (state, outcome) = told
    assert running is None and state == "failed"
    assert outcome.error.startswith("its task failed: FileNotFoundError")


def test_a_cluster_that_does_not_answer(files):
    with socket.socket() as held:  # bound, and nobody listens
        held.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{held.getsockname()[1]}"
        with pytest.raises(DroidwError, match="Ray cannot be started or reached") as caught:
            run_on_ray([], lambda *_: None, 1, address=place)
    assert "--ray-address" in caught.value.hint


def test_a_cell_that_needs_more_than_there_is_fails_and_does_not_wait(tmp_path):
    pytest.importorskip("ray", reason="extra ray")
    told, cell = [], Cell("full", "room", 0, "seed: 0\n", gpus=64)
    run_on_ray([(cell, tmp_path)], lambda _, state, outcome: told.append((state, outcome)), 1)
    ((state, outcome),) = told
    assert state == "failed"
    assert outcome.error.startswith("it needs 64 GPUs, and this machine has ")


def test_without_ray_it_is_said(files, monkeypatch):
    absent = SimpleNamespace(util=SimpleNamespace(find_spec=lambda name: None))
    monkeypatch.setattr(on_ray, "importlib", absent)
    with pytest.raises(MissingRequirementError, match="'ray' is not installed") as caught:
        run(files, "never", executor="ray")
    assert "pip install 'droidw[ray]'" in caught.value.hint
    assert not (files / "never").exists()
    with pytest.raises(MissingRequirementError):
        run_on_ray([], lambda *_: None, 1)
