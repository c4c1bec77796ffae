"""Means, spreads, ratios, and the forms of a table."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from xml.etree import ElementTree

import pytest

from droidw.ablation.cells import Cell, Outcome
from droidw.ablation.files import FILES, comma_separated, markdown, write_files
from droidw.ablation.page import make_page
from droidw.ablation.plan import Footage, Plan
from droidw.ablation.table import make_table

NONE = ("", {})


def plan(rows, sequences, seeds, columns=("ate_rmse", "masks.auc")):
    footage = {name: Footage(name, NONE) for name in sequences}
    layers = dict.fromkeys(rows, NONE)
    return Plan("p.yaml", "T < 1", "cpu", (), NONE, footage, tuple(seeds), layers, tuple(columns))


def table(values, seeds=(0, 1, 2), columns=("ate_rmse", "masks.auc"), curve=None):
    """values: (row, sequence) -> a figure per seed; a text is an error, None has not run."""
    rows = list(dict.fromkeys(row for row, _ in values))
    sequences = list(dict.fromkeys(sequence for _, sequence in values))
    cells = []
    for (row, sequence), figures in values.items():
        for seed, value in zip(seeds, figures, strict=True):
            outcome = None
            if isinstance(value, str):
                outcome = Outcome({}, {}, {}, value, 4)
            elif value is not None:
                metrics = {"ate_rmse": value, "masks.auc": 1 - value / 10, "odd": 5.0}
                outcome = Outcome(metrics, {"unit": "m"}, curve or {}, seconds=2.0)
            cells.append((Cell(row, sequence, seed, "seed: 1\n"), outcome))
    return make_table(plan(rows, sequences, seeds, columns), cells)


FULL = table(
    {
        ("full", "a"): [1.0, 2.0, 3.0],
        ("full", "b"): [4.0, 4.0, 4.0],
        ("worse", "a"): [4.0, 4.0, 4.0],
        ("worse", "b"): [2.0, "no | luck", 2.0],
        ("lost", "a"): ["a", "b", "c"],
        ("lost", "b"): [1.0, 1.0, None],
    }
)


def test_means_and_spreads():
    entry = FULL.entry("ate_rmse", "full", "a")
    assert (entry.mean, entry.spread, entry.values) == (2.0, 1.0, (1.0, 2.0, 3.0))
    some = FULL.entry("ate_rmse", "worse", "b")
    assert (some.mean, some.spread, some.wanted) == (2.0, 0.0, 3)
    assert some.errors == ("no | luck",)
    lost = FULL.entry("ate_rmse", "lost", "a")
    assert (lost.mean, lost.spread, lost.errors) == (None, None, ("a", "b", "c"))
    assert FULL.entry("ate_rmse", "lost", "b").errors == ("not run",)
    one = table({("full", "a"): [1.0]}, seeds=(0,)).entry("ate_rmse", "full", "a")
    assert (one.mean, one.spread) == (1.0, None)


def test_averages_and_ratios():
    assert FULL.average("ate_rmse", "full") == 3.0
    assert FULL.average("ate_rmse", "lost") is None
    # Twice as bad on one sequence and half as bad on the other is as bad.
    assert FULL.ratio("ate_rmse", "worse") == pytest.approx(1.0)
    assert FULL.ratio("ate_rmse", "full") == 1.0 and FULL.ratio("ate_rmse", "lost") is None
    doubled = table({("full", "a"): [0.1], ("r", "a"): [0.2]}, seeds=(0,))
    assert doubled.ratio("ate_rmse", "r") == pytest.approx(2.0)
    nothing = table({("full", "a"): [0.0], ("r", "a"): [0.2]}, seeds=(0,))
    assert nothing.ratio("ate_rmse", "r") is None


def test_a_figure_that_not_every_sequence_has():
    found = table({("full", "a"): [1.0], ("full", "b"): ["x"]}, seeds=(0,))
    assert found.having("ate_rmse") == ("a",)
    assert found.grid(found.columns[0]) == [["", "a", "x full"], ["full", "1.0000", "1.00"]]
    none = table({("full", "a"): ["x"]}, seeds=(0,))
    assert none.columns == () and none.failures()[0][1] == "x"
    assert "Without a result" in markdown(none) and make_page(none)


def test_a_sequence_without_any_result_is_told(tmp_path):
    found = table({("full", "a"): [1.0], ("full", "b"): ["x"]}, seeds=(0,))
    assert ("b", "no cell has a result: it is not in the tables, nor in their means") in (
        found.remarks()
    )
    nothing = table({("full", "a"): ["x"]}, seeds=(0,))
    assert not [name for name, _ in nothing.remarks() if name == "a"]


def test_what_has_not_run_has_not_failed():
    found = table({("full", "a"): [1.0], ("r", "a"): [None]}, seeds=(0,))
    assert found.grid(found.columns[0])[2] == ["r", "not run", "-"]


def test_markdown():
    text = markdown(FULL, "droidw ablate p.yaml")
    lines = text.splitlines()
    assert lines[0] == "# T < 1" and "    droidw ablate p.yaml" in lines
    assert "## ATE rmse, all frames [m] (less is better)" in lines
    assert "|  | a | b | mean | x full |" in lines
    assert "| full | 2.0000 ± 1.0000 | 4.0000 ± 0.0000 | 3.0000 | 1.00 |" in lines
    assert "| worse | 4.0000 ± 0.0000 | 2.0000 ± 0.0000 (2 of 3) | 3.0000 | 1.00 |" in lines
    assert "| lost | failed | 1.0000 ± 0.0000 (2 of 3) | - | - |" in lines
    assert "- `worse/b/seed-1`: no | luck" in lines and "- `lost/b/seed-2`: not run" in lines


def test_what_is_to_be_known_of_figures():
    assert FULL.remarks() == [] and "To be known" not in markdown(FULL) + make_page(FULL)
    known = table({("full", "a"): [1.0, "lost"]}, (0, 1), ("ate_rmse", "masks.auk"))
    cell, outcome = known.cells[0]
    facts = {"warnings": ["it <blinks>"], "notes": ["few masks", "it <blinks>"]}
    known = replace(known, cells=((cell, replace(outcome, facts=facts)), *known.cells[1:]))
    assert known.remarks() == [
        ("masks.auk", "no cell has this figure"),
        ("full/a/seed-0", "it <blinks>"),
        ("full/a/seed-0", "few masks"),
    ]
    assert "## To be known\n\n- `masks.auk`: no cell" in markdown(known)
    assert "it &lt;blinks&gt;" in make_page(known)


def test_cells_of_other_versions_are_told():
    known = table({("full", "a"): [1.0, 2.0, "lost"]})
    made = []
    for (cell, outcome), torch in zip(known.cells, ("2.13.0", "2.14.1", "2.9.0"), strict=True):
        facts = {"versions": {"droidw": "0.1.0", "torch": torch}}
        made.append((cell, replace(outcome, facts=facts)))
    assert replace(known, cells=tuple(made)).remarks() == [
        ("cells", "they differ in what made them, torch: 2.13.0, 2.14.1")
    ]


def test_csv_has_every_cell_and_every_figure():
    rows = list(csv.DictReader(io.StringIO(comma_separated(FULL))))
    assert len(rows) == 18
    assert rows[0] == {
        "row": "full", "sequence": "a", "seed": "0", "error": "",
        "ate_rmse": "1.0", "masks.auc": "0.9", "odd": "5.0",
    }  # fmt: skip
    failed = [row for row in rows if row["error"]]
    assert len(failed) == 5 and all(row["ate_rmse"] == "" for row in failed)


def test_json(tmp_path):
    written = write_files(FULL, tmp_path)
    assert [path.name for path in written] == list(FILES)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(FILES)
    record = json.loads((tmp_path / "table.json").read_text(), parse_constant=pytest.fail)
    assert record["figures"]["ate_rmse"]["full"]["a"]["mean"] == 2.0
    assert record["columns"] == ["ate_rmse", "masks.auc"] and len(record["cells"]) == 18
    assert record["cells"][0]["folder"] == "cells/full/a/seed-0"


def test_page():
    s = [0.1 * k for k in range(20)]
    path = [[math.cos(x), x, 0.0] for x in s]
    curve = {"unit": "m", "times": s, "errors": s, "path": path, "truth": path}
    found = table({("full", "a"): [1.0, 2.0, 3.0], ("r", "a"): [2.0, 2.0, "<b>"]}, curve=curve)
    text = make_page(found, "droidw ablate 'a & b'")
    assert "<h1>T &lt; 1</h1>" in text and "5 of 6 cells have a result" in text
    assert "droidw ablate &#x27;a &amp; b&#x27;" in text and "&lt;b&gt;" in text
    # Two bar charts, the errors and the paths.
    assert text.count("<svg") == 4 and "<script" not in text
    # One tree: every element is closed.
    for open_ended in ("<!doctype html>", "<meta charset='utf-8'>"):
        text = text.replace(open_ended, "")
    ElementTree.fromstring(text.replace("<meta name='viewport' content='width=device-width'>", ""))
    assert text.count("class='best'") == 2  # ATE and AUC, one sequence
    assert make_page(found, "x") == make_page(found, "x")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([0.0343, 0.5], ["0.0343", "0.5000"]),
        ([0.000445, 0.0448], ["0.000445", "0.044800"]),
        ([0.0, 0.0012], ["0.00000", "0.00120"]),
        ([3e-12, 1.0], ["0.00000000", "1.00000000"]),
    ],
)
def test_errors_have_as_many_digits_as_the_least_of_them_needs(values, said):
    found = table({("full", "a"): [values[0]], ("r", "a"): [values[1]]}, seeds=(0,))
    grid = found.grid(found.columns[0])
    assert [row[1] for row in grid[1:]] == said
    auc = found.grid(found.columns[1])
    assert all(len(row[1].partition(".")[2]) == 3 for row in auc[1:])
