"""Running cells: what is kept, what fails, what runs at the same time, what a kill leaves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from droidw.ablation import local
from droidw.ablation.cells import make_cells, prepare, read_outcome
from droidw.errors import UsageError


def states(told, state):
    return [name for name, s in told if s == state]


@pytest.mark.usefixtures("stand_in")
def test_every_cell_runs_once_and_never_again(plan, go, started, tmp_path):
    found = plan(["full", "worse"], seeds=[0, 1])
    table, told = go(found, jobs=3)
    assert len(states(told, "done")) == 8 and len(started()) == 8
    entry = table.entry("ate_rmse", "worse", "two")
    assert entry.values == (2.0, 2.1) and entry.mean == pytest.approx(2.05)
    again, told = go(found)
    assert states(told, "kept") == [cell.name for cell, _ in table.cells]
    assert len(started()) == 8 and again.to_dict() == table.to_dict()
    # Another row joins; a row that is another now runs again, the rest stays.
    more = plan({"full": {}, "worse": {"frontend": {"window": 20}}, "new": {}}, seeds=[0, 1])
    _, told = go(more)
    assert {name.split("/")[0] for name in states(told, "done")} == {"worse", "new"}
    assert len(states(told, "kept")) == 4
    # Asked for, all run again.
    _, told = go(found, again=True)
    assert len(states(told, "done")) == 8
    assert json.loads((tmp_path / "out" / "table.json").read_text())["rows"] == ["full", "worse"]


@pytest.mark.usefixtures("stand_in")
def test_cells_that_fail_say_why_and_the_table_is_made(plan, go, started, tmp_path):
    rows = ["full", "aborts", "complains", "mute", "endless"]
    found = plan(rows, sequences=["one"])
    began = time.monotonic()
    table, told = go(found, jobs=2, limit=3.0)
    assert time.monotonic() - began < 60
    assert states(told, "done") == ["full/one/seed-0"]
    assert {cell.row: why for cell, why in table.failures()} == {
        "aborts": "its process was ended by SIGABRT",
        "complains": "the footage is blank",
        "mute": "its process ended with exit code 7",
        "endless": "took longer than it may (--limit), ended after 3 s",
    }
    assert {c.row: o.code for c, o in table.cells} == {
        "full": 0, "aborts": 1, "complains": 1, "mute": 7, "endless": 1,
    }  # fmt: skip
    text = (tmp_path / "out" / "table.md").read_text()
    assert "| aborts | failed | - |" in text and "`mute/one/seed-0`: its process" in text
    failure = tmp_path / "out" / "cells" / "mute" / "one" / "seed-0" / "failure.json"
    assert json.loads(failure.read_text())["code"] == 7
    # What failed is tried again, what is finished is not.
    count = len(started())
    go(plan(["full", "mute"], sequences=["one"]))
    assert started()[count:] == ["mute/one/0"]


@pytest.mark.usefixtures("stand_in")
def test_a_result_is_kept_until_its_cell_runs_again(plan, go, tmp_path):
    found = plan(["full"])
    table, _ = go(found)
    cell = table.cells[0][0]
    folder = tmp_path / "out" / "cells" / cell.name
    prepare(cell, folder, found.measure)
    assert read_outcome(cell, folder, found.measure) is not None
    # Measured otherwise, from files that are gone: it runs again.
    assert read_outcome(cell, folder, replace(found.measure, align="se3")) is None
    local.end(local.launch(folder))
    assert read_outcome(cell, folder, found.measure) is None


@pytest.mark.usefixtures("stand_in")
def test_jobs_run_side_by_side(plan, go):
    _, told = go(plan(["slow"], seeds=[0, 1]), jobs=2)
    running, most = 0, 0
    for _, state in told:
        running += {"running": 1, "done": -1}[state]
        most = max(most, running)
    assert most == 2


@pytest.mark.usefixtures("stand_in")
def test_a_stop_ends_what_runs_and_writes_the_table(plan, go, started, tmp_path):
    found = plan(["full", "endless"], sequences=["one"])
    stops = iter([False] * 20 + [True] * 1000)
    table, told = go(found, jobs=1, stopped=lambda: next(stops) and bool(states_of(started)))
    assert states(told, "running") == ["full/one/seed-0", "endless/one/seed-0"]
    assert [why for _, why in table.failures()] == ["not run"]
    pid = int((tmp_path / "out" / "started.txt").read_text().splitlines()[-1].split()[1])
    assert gone(pid)
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.usefixtures("stand_in")
def test_what_a_stop_leaves_undone_keeps_its_earlier_result(plan, go, started, tmp_path):
    rows = ["full", "slow", "mute"]
    before, _ = go(plan(["full", "slow"], sequences=["one"]))
    place = tmp_path / "out" / "cells" / "slow" / "one" / "seed-0"
    kept = {path.name: path.read_bytes() for path in place.iterdir() if path.is_file()}
    count = len(started())
    stops = iter([False] + [True] * 1000)
    table, told = go(plan(rows, sequences=["one"]), jobs=1, again=True, stopped=lambda: next(stops))
    assert states(told, "running") == ["full/one/seed-0"] and len(started()) <= count + 1
    found = {cell.row: outcome for cell, outcome in table.cells}
    assert found["slow"] is not None
    assert found["slow"].metrics == before.cells[1][1].metrics
    assert found["mute"] is None
    # Nothing of the call that did not run it.
    assert {path.name: path.read_bytes() for path in place.iterdir() if path.is_file()} == kept


def states_of(started):
    return [name for name in started() if name.startswith("endless")]


def gone(pid, seconds=10.0):
    """Whether a process has ended, soon."""
    for _ in range(int(seconds / 0.05)):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        if Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z":
            return True
        time.sleep(0.05)
    return False


KILLED = """
import sys
from droidw.ablation import local
local.MODULE = "stand_in_cell"
from droidw.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def test_a_killed_ablation_goes_on_where_it_was(plan, started, stand_in, tmp_path):
    found = plan(["full", "worse", "slow", "endless"], sequences=["one"])
    out = tmp_path / "out"
    command = [sys.executable, "-c", KILLED, "ablate", found.file, "-o", str(out), "--jobs", "1"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        for _ in range(1200):
            if "endless/one/0" in started():
                break
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        process.kill()
    finally:
        process.kill()
        process.wait()
    assert started() == [f"{row}/one/0" for row in ("full", "worse", "slow", "endless")]
    assert not (out / "table.md").exists()
    # The row that never ended is left to others: the rest is not run again.
    done = subprocess.run(
        [*command, "--rows", "full,worse,slow"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("kept") == 3 and len(started()) == 4
    assert "| full | 1.0000 | 1.00 |" in (out / "table.md").read_text()


@pytest.mark.usefixtures("stand_in")
def test_a_folder_that_holds_something_else(plan, go, tmp_path):
    found = plan(["full"])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    with pytest.raises(UsageError, match=r"holds something that is no ablation \(thesis\.tex\)"):
        go(found)
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot be the output folder"):
        go(found, out="file")


@pytest.mark.usefixtures("stand_in")
def test_two_ablations_do_not_share_a_folder(plan, go, tmp_path):
    import fcntl

    found = plan(["full"])
    go(found)
    with (tmp_path / "out" / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="another `droidw ablate` works in this folder"):
            go(found)


@pytest.mark.usefixtures("stand_in")
def test_what_a_cell_is_given(plan, go, tmp_path, plugins):
    found = plan({"full": {"threads": 3}}, sequences=["one"])
    table, _ = go(found, plugin_files=("some/plugin.py",), data=Path("datasets"))
    ((cell, outcome),) = table.cells
    folder = tmp_path / "out" / "cells" / cell.name
    spec = json.loads((folder / "cell.json").read_text())
    assert spec["plugins"] == [str(Path("some/plugin.py").resolve())]
    assert spec["data"] == str(Path("datasets").resolve()) and spec["threads"] == 3
    assert outcome.metrics["threads"] == 3
    assert yaml.safe_load((folder / "cell.yaml").read_text())["threads"] == 3


def test_a_cell_ends_with_its_parent(tmp_path, stand_in):
    """The real process of a cell, whose parent is killed while it waits for its turn."""
    folder = tmp_path / "cell"
    folder.mkdir()
    parent = subprocess.Popen(
        [
            sys.executable, "-c",
            "import subprocess, sys, time, os\n"
            "child = subprocess.Popen([sys.executable, '-m', 'droidw.cli.cell', sys.argv[1],"
            " str(os.getpid())])\n"
            "print(child.pid, flush=True)\n"
            "time.sleep(600)\n",
            str(folder),
        ],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    import fcntl

    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        pid = int(parent.stdout.readline())
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        assert gone(pid, 30.0)


@pytest.mark.usefixtures("stand_in")
def test_a_row_that_cannot_run_here_is_in_the_table(plan, plugins, go, started):
    found = plan({"full": {}, "droid": {"correspondence": "droid"}}, sequences=["one"])
    cells, _ = make_cells(found, plugins)
    table, told = go(found)
    assert ("droid/one/seed-0", "missing") in told and started() == ["full/one/0"]
    assert table.failures() == [(cells[1], cells[1].missing)]
