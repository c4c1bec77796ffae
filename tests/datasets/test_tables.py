"""The tables of the datasets: every constant of the paper's set-up, and names made into places."""

from __future__ import annotations

import pytest

from droidw.errors import InputError
from droidw.io.dataset_tables import data_root, load_table, split_source, table_names

COUNTS = {"bonn": 8, "droidw": 7, "dycheck": 12, "tum": 9, "youtube": 14}


def test_every_dataset_of_the_paper_is_there():
    assert set(COUNTS) <= set(table_names())
    for name, count in COUNTS.items():
        table = load_table(name)
        assert len(table.sequences) == count and table.title and table.page and table.licence
        known = [n for row in table.sequences.values() for n in (row.name, *row.also)]
        assert len(known) == len(set(known))


@pytest.mark.parametrize("name", COUNTS)
def test_every_row_has_a_camera_and_a_place(name):
    for row in load_table(name).sequences.values():
        camera = row.raw_camera().validated(row.source)
        assert 0.2 < camera.cx / camera.width < 0.8 and 0.2 < camera.cy / camera.height < 0.8
        assert row.name in row.folder and "{" not in row.folder + row.archive + row.unpack
        assert row.archive.startswith("https://") or name == "dycheck"
        assert row.ate is not None or name == "youtube"


def test_published_averages_are_those_of_the_rows():
    """The paper's own averages, from its rows: a slip of the pen in the table would show."""
    averages = {"bonn": (2.30, 0.02), "tum": (1.36, 0.01), "dycheck": (0.034, 0.001),
                "droidw": (0.230, 0.001)}  # fmt: skip
    for name, (average, within) in averages.items():
        errors = [row.ate for row in load_table(name).sequences.values()]
        assert sum(errors) / len(errors) == pytest.approx(average, abs=within)


def test_only_the_corrected_row_has_a_published_camera():
    rows = [r for name in COUNTS for r in load_table(name).sequences.values() if r.published]
    assert [row.source for row in rows] == ["dycheck:haru-sit"]
    assert rows[0].raw_camera(published=True).cx == 480.0
    assert rows[0].raw_camera().cx == 360.0


def test_datasets_beside_the_paper_are_by_hand_and_calibrated_on_disk():
    for name in ("kitti", "euroc"):
        for row in load_table(name).sequences.values():
            assert not row.archive and row.raw_camera() is None and row.ate is None


def test_unknown_names_are_told_with_the_list():
    with pytest.raises(InputError, match="no dataset is called 'bon'") as error:
        load_table("bon")
    assert "did you mean 'bonn'" in error.value.hint and "dycheck" in error.value.hint
    with pytest.raises(InputError, match="has no sequence 'crowdd'") as error:
        load_table("bonn").sequence("crowdd")
    assert "bonn:crowd" in error.value.hint and "person_tracking2" in error.value.hint


def test_what_is_a_name_and_what_a_path(tmp_path, monkeypatch):
    assert split_source("bonn:balloon") == ("bonn", "balloon")
    assert split_source("tum:f3/wx") == ("tum", "f3/wx")
    for path in ("clip.mp4", "https://x/y", "C:\\clip", "/a:b", "", "bonn"):
        assert split_source(path) is None
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a:b").mkdir()
    assert split_source("a:b") is None


def test_the_folder_of_datasets(tmp_path):
    assert data_root({"DROIDW_DATA": "~/d"}).name == "d" and data_root(
        {"XDG_CACHE_HOME": "/c"}
    ).parts[-2:] == ("droidw", "data")
    assert data_root({}).parts[-3:] == (".cache", "droidw", "data")
