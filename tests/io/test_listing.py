"""Listings of pictures: names with anything in them, and times that stray."""

from __future__ import annotations

import math

import pytest

from droidw.io.listing import in_folder, read_listing
from droidw.io.notes import Notes
from droidw.io.rising import longest_rising, rising


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("1.5 rgb/a.png", "a.png"),
        ("1.5,rgb/a,1.png", "a,1.png"),
        ("1.5 rgb/a,1.png", "a,1.png"),
        ("1.5\trgb/b#2.png", "b#2.png"),
        ("1.5 rgb/two words.png", "two words.png"),
        ("1.5 rgb/a.png # remark", "a.png"),
        ("  1.5 rgb/a.png  ", "a.png"),
        ("1.5, rgb/a.png,", "a.png"),
    ],
)
def test_names_hold_what_files_may_be_called(tmp_path, line, name):
    (tmp_path / "rgb.txt").write_text(f"# times, names\n{line}\n")
    problems: list[str] = []
    assert read_listing(tmp_path / "rgb.txt", Notes(problems)) == [
        (0, 1.5, tmp_path / "rgb" / name)
    ]
    assert problems == []


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        ([], []),
        ([1, 2, 3], [0, 1, 2]),
        ([1, 2, 99, 3, 4], [0, 1, 3, 4]),
        ([5, 5, 6], [0, 2]),
        ([3, 2, 1], [2]),
        ([0, 2, 1, 3], [0, 2, 3]),
    ],
)
def test_one_stray_value_costs_no_other(values, kept):
    found = longest_rising(values)
    assert [values[i] for i in found] == [values[i] for i in kept]
    assert found == sorted(found)


@pytest.mark.parametrize(
    ("values", "kept"),
    [([], []), ([0, 2, 1, 3], [0, 1, 3]), ([1, 2, 99, 3, 4], [0, 1, 3, 4]), ([3, 2], [0])],
)
def test_what_runs_backwards_is_left_out(values, kept):
    assert rising(values) == kept


def test_pictures_without_times_have_none(tmp_path):
    assert in_folder(tmp_path) == []
    (tmp_path / "rgb").mkdir()
    for name in ("f10.png", "f9.png", ".f1.png"):
        (tmp_path / "rgb" / name).touch()
    found = in_folder(tmp_path)
    assert [(i, path.name) for i, _, path in found] == [(0, "f9.png"), (1, "f10.png")]
    assert all(math.isnan(time) for _, time, _ in found)
