"""The arithmetic of benchmarks/ratios.py, without a run."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def bench(load_benchmark, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return load_benchmark("ratios")


@pytest.fixture
def cells(bench, tmp_path):
    lines = ["row,sequence,seed,error,ate_rmse,masks.auc"]
    lines += [f"full,room,{seed},,{ate}," for seed, ate in ((0, 0.001), (1, 0.004), (2, 0.1))]
    lines += [f"full,room_late,{seed},,{ate}," for seed, ate in ((0, 0.010), (1, 0.010))]
    lines += ["full,room_dog,0,,0.002,0.98", "full,room_dog,1,,0.002,0.95", "full,room_dog,3,,1,1"]
    lines += ["full,room_late_cat,0,,0.015,0.99", "full,room_late_cat,1,lost,,"]
    lines += ["no-uncertainty,room,0,,0.002,", "no-uncertainty,room_dog,0,,0.5,"]
    file = tmp_path / "cells.csv"
    file.write_text("\n".join(lines) + "\n")
    return bench.read([file], "ate_rmse"), bench.read([file], "masks.auc")


def test_movers_are_held_against_their_clip(bench, cells):
    # over the seeds that both have: (2/1, 2/4) are 1 in the mean
    assert bench.moving(*cells) == [
        "| room_dog | 2 2 1e+03 | 1 4 100 | 1.00 | 0.950 |",
        "| room_late_cat | 15 | 10 10 | 1.50 | 0.990 |",
        "| geometric mean |  |  | 1.22 |  |",
    ]


def test_what_stands_still_is_held_against_none(bench, cells):
    assert bench.standing(*cells) == [
        "| room | 1 4 100 | 2 | 0.50 |",
        "| geometric mean |  |  | 0.50 |",
    ]


def test_a_clip_goes_on_from_the_longest_name(bench):
    assert bench.alone("room_late_cat", ["room", "room_late", "roo"]) == "room_late"
    assert bench.alone("rooms", ["room"]) is None


def test_movers_are_held_against_none(bench, cells):
    # 0.5 m without uncertainty: 500 times the static figure of that seed, of which 0.004 is left
    assert bench.trusted(*cells) == ["| room_dog | 2 2 1e+03 | 500 | 500 | 0.004 |"]


def test_masks_are_the_least_of_all_seeds(bench, cells):
    assert bench.masks(cells[1]) == ["| room_dog | 0.950 |", "| room_late_cat | 0.990 |"]


def test_tables_are_kept_with_the_machine(bench, cells, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "RESULTS", tmp_path)
    text = bench.tables(*cells)
    kept = bench.save("moving", text).read_text()
    assert text in kept and "| cores |" in kept
    assert "| masks | least AUC |" in text and "| nothing moves |" in text


def test_empty_tables_are_left_out(bench):
    full = {("full", "room"): {0: 0.001}, ("full", "room_dog"): {0: 0.002}}
    text = bench.tables(full, {("full", "room_dog"): {0: 0.97}})
    assert "none" not in text and "| room_dog | 2 | 1 | 2.00 | 0.970 |" in text
