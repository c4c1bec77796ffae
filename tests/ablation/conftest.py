"""Cells that take no time: a stand-in for their process, which the orchestration cannot tell."""

from __future__ import annotations

import pytest

from droidw.ablation import local
from droidw.ablation.cells import make_cells
from droidw.ablation.plan import load_plan
from droidw.ablation.run import Means, run_ablation
from droidw.plugin.manager import load_plugins

STAND_IN = '''
"""What a row is called decides what its cell does."""
import json, os, sys, time
from pathlib import Path

folder = Path(sys.argv[1])
spec = json.loads((folder / "cell.json").read_text())
with (folder.parents[3] / "started.txt").open("a") as stream:
    stream.write(f"{spec['row']}/{spec['sequence']}/{spec['seed']} {os.getpid()}\\n")
row = spec["row"]
if row == "aborts":
    os.abort()
if row == "complains":
    print("a warning first", file=sys.stderr)
    sys.exit("droidw: error: the footage is blank\\n  look at it")
if row == "mute":
    sys.exit(7)
if row == "endless":
    time.sleep(600)
if row == "slow":
    time.sleep(0.4)
mean = {"full": 1.0, "worse": 2.0}.get(row, 1.5)
record = {
    **{key: spec[key] for key in ("row", "sequence", "seed", "digest", "measure")},
    "metrics": {"ate_rmse": mean + 0.1 * spec["seed"], "fps": 10.0, "threads": spec["threads"]},
    "facts": {"unit": "m", "versions": {"droidw": "0"}}, "curve": {}, "seconds": 0.1,
}
(folder / "result.json").write_text(json.dumps(record))
'''


@pytest.fixture(scope="session")
def plugins():
    """The built-ins alone."""
    return load_plugins(environ={"DROIDW_LOAD_PLUGINS": ""})


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Cells run the stand-in; returns the folder that its module is in."""
    place = tmp_path / "stand-in"
    place.mkdir()
    (place / "stand_in_cell.py").write_text(STAND_IN)
    monkeypatch.setenv("PYTHONPATH", str(place))
    monkeypatch.setattr(local, "MODULE", "stand_in_cell")
    return place


@pytest.fixture
def plan(tmp_path):
    """Write and read an ablation: `plan({"full": {}}, seeds=[0, 1])`."""

    def write(rows, sequences=("one", "two"), **more):
        import yaml

        for sequence in sequences:
            (tmp_path / "data" / sequence).mkdir(parents=True, exist_ok=True)
        tree = {
            "preset": "cpu",
            "base": {"device": "cpu"},
            "data": str(tmp_path / "data"),
            "sequences": list(sequences),
            "rows": rows if isinstance(rows, dict) else {row: {} for row in rows},
            **more,
        }
        file = tmp_path / "plan.yaml"
        file.write_text(yaml.safe_dump(tree, sort_keys=False))
        return load_plan(str(file))

    return write


@pytest.fixture
def go(tmp_path, plugins):
    """Run a plan into a folder; returns its table and what was told."""

    def run(plan, *overrides, out="out", stopped=lambda: False, **means):
        told = []
        cells, _ = make_cells(plan, plugins, overrides)
        table = run_ablation(
            plan, cells, tmp_path / out, Means(**means),
            lambda cell, state, outcome: told.append((cell.name, state)), stopped,
        )  # fmt: skip
        return table, told

    return run


@pytest.fixture
def started(tmp_path):
    """Cells whose process was started, in order."""

    def read(out="out"):
        file = tmp_path / out / "started.txt"
        return [line.split()[0] for line in file.read_text().splitlines()] if file.exists() else []

    return read
