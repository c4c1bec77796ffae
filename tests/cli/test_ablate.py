"""`droidw ablate` on the command line: what it says, shows and returns."""

from __future__ import annotations

import io
import json

import pytest

from droidw.ablation import local
from droidw.ablation.cells import Cell, Outcome
from droidw.ablation.plan import load_plan
from droidw.cli.live import Live
from droidw.cli.main import main

STAND_IN = """
import json, sys
from pathlib import Path
folder = Path(sys.argv[1])
spec = json.loads((folder / "cell.json").read_text())
if spec["row"] == "bad":
    sys.exit("droidw: error: nothing could be matched") if spec["seed"] else sys.exit(4)
record = {key: spec[key] for key in ("row", "sequence", "seed", "digest", "measure")}
record.update(metrics={"ate_rmse": 1.25 + spec["seed"]}, facts={"unit": "m"}, curve={}, seconds=1)
(folder / "result.json").write_text(json.dumps(record))
"""


@pytest.fixture
def ablate(tmp_path, monkeypatch, capsys):
    """`ablate(*words)` on a plan of two rows; cells take no time."""
    place = tmp_path / "stand-in"
    place.mkdir()
    (place / "stand_in_cli_cell.py").write_text(STAND_IN)
    monkeypatch.setenv("PYTHONPATH", str(place))
    monkeypatch.setattr(local, "MODULE", "stand_in_cli_cell")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data" / "room").mkdir(parents=True)
    (tmp_path / "plan.yaml").write_text(
        "preset: cpu\nbase: {device: cpu}\nsequences: [room]\nrows: {full: {}, bad: {}}\n"
    )

    def run(*words):
        code = main(["ablate", *words])
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def test_table_and_files(ablate, tmp_path):
    code, out, err = ablate("plan.yaml", "--data", "data", "--rows", "full", "--seeds", "0,1")
    assert code == 0
    assert "ATE rmse, all frames [m]" in out and "1.7500 ± 0.7071" in out
    assert "[2/2] full/room/seed-1: done in" in err and "ate_rmse 2.25" in err
    folder = tmp_path / "runs" / "ablations" / "plan"
    for name in ("table.md", "cells.csv", "table.json", "report.html"):
        assert f"runs/ablations/plan/{name}" in out and (folder / name).is_file()
    command = "droidw ablate plan.yaml --data data --rows full --seeds 0,1"
    assert command in (folder / "table.md").read_text()


def test_a_failed_cell_decides_the_code(ablate):
    code, out, err = ablate("plan.yaml", "--data", "data", "-o", "out", "--jobs", "2")
    assert code == 4
    assert "without a result:\n  bad/room/seed-0  its process ended with exit code 4" in out
    assert "bad/room/seed-0: failed" in err and "full/room/seed-0: done" in err
    code, out, _ = ablate("plan.yaml", "--data", "data", "-o", "out", "--json", "-q")
    record = json.loads(out)
    assert code == 4 and record["figures"]["ate_rmse"]["full"]["room"]["mean"] == 1.25


def test_what_is_wrong_is_said_before_anything_runs(ablate, tmp_path):
    (tmp_path / "wrong.yaml").write_text(
        "sequences: [room]\npreset: cpu\nrows:\n  full: {}\n  swap: {uncertainty: mlpp}\n"
    )
    data = ("--data", "data")
    cases = [
        (("nothing.yaml",), 2, "nothing.yaml: there is no such configuration file"),
        (("demoo",), 2, "did you mean 'demo'?"),
        (("wrong.yaml", *data), 5, "wrong.yaml:5: rows.swap: uncertainty.name: no uncertainty"),
        (("plan.yaml",), 3, "of 1 sequences, 1 are not there: room (room)"),
        (("plan.yaml", *data, "--rows", "fool"), 2, "plan.yaml has no row 'fool'"),
        (("plan.yaml", *data, "--seeds", "a"), 2, "--seeds: 'a' is no list of whole numbers"),
        (("plan.yaml", *data, "--seeds=-1"), 2, "holds a number below 0"),
        (("plan.yaml", *data, "--jobs", "0"), 2, "--jobs counts from 1"),
        (("plan.yaml", *data, "--limit", "-1"), 2, "--limit is a number of seconds above 0"),
        (("plan.yaml", *data, "--limit", "nan"), 2, "--limit is a number of seconds above 0"),
        (("plan.yaml", *data, "--ray-address", "auto"), 2, "--ray-address is for --executor ray"),
        (("plan.yaml", *data, "fast"), 2, "'fast' is neither an option nor an override"),
        (("plan.yaml", *data, "camera.fovv=3"), 2, "command line: camera.fovv"),
    ]
    for words, expected, said in cases:
        code, out, err = ablate(*words)
        assert (code, out) == (expected, ""), words
        assert said in err, err
    assert not (tmp_path / "runs").exists()


class Terminal(io.StringIO):
    def isatty(self):
        return True


def screen(text):
    """What a terminal shows in the end: cursor up to the start of a line, clear below."""
    lines = [""]
    for part in text.replace("\x1b[J", "\0").split("\x1b["):
        count, _, rest = part.partition("F\0") if "F\0" in part else ("0", "", part)
        lines = lines[: len(lines) - int(count)] if int(count) else lines
        if int(count):
            lines[len(lines) - 1 :] = [""]
        for piece in rest.splitlines(keepends=True):
            lines[-1] += piece.rstrip("\n")
            if piece.endswith("\n"):
                lines.append("")
    return lines


def test_the_table_is_redrawn_on_a_terminal(tmp_path):
    (tmp_path / "p.yaml").write_text(
        "sequences: [one, two]\nseeds: [0, 1]\nrows: {full: {}, other: {}}\n"
    )
    plan = load_plan(str(tmp_path / "p.yaml"))
    cells = [
        Cell(row, sequence, seed, "")
        for row in plan.rows
        for sequence in plan.sequences
        for seed in plan.seeds
    ]
    stream = Terminal()
    with Live(plan, cells, stream) as live:
        live.say("a note")
        live.tell(cells[0], "running", None)
        live.tell(cells[0], "done", Outcome({"ate_rmse": 0.5}, {}, {}))
        live.tell(cells[1], "done", Outcome({"ate_rmse": 0.7}, {}, {}))
        live.tell(cells[2], "failed", Outcome({}, {}, {}, "no luck", 4))
    shown = "\n".join(screen(stream.getvalue()))
    assert shown.count("full") == 2 and "a note" in shown  # once in the note of the failure
    assert "full/two/seed-0: no luck" in shown
    assert "full   0.6        1 failed 1 waiting" in shown
    assert "other  2 waiting  2 waiting" in shown
    assert "2 done, 1 failed, 5 waiting" in shown
