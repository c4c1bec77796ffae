"""A dataset as source brings the settings of the paper along, under the presets that it names."""

from __future__ import annotations

import pytest

from droidw.config.load import load_config
from droidw.io.dataset_tables import load_table, table_names


def loaded(source, preset="paper", *overrides, **more):
    return load_config(preset=preset, values={"input.source": source}, overrides=overrides, **more)


@pytest.mark.parametrize(
    ("source", "size", "edge", "force", "gamma", "stride"),
    [
        ("bonn:balloon", [512, 384], 0, 9, 0.001, 1),
        ("tum:freiburg3_walking_xyz", [512, 384], 8, 9, 0.001, 1),
        ("tum:f2/dp", [320, 240], 8, 0, 0.001, 1),
        ("dycheck:apple", [360, 480], 0, 9, 0.001, 1),
        ("droidw:downtown7", [480, 360], 8, 0, 0.01, 1),
        ("youtube:giraffe", [640, 360], 0, 0, 0.01, 1),
        ("youtube:tomyum2", [640, 360], 0, 0, 0.01, 2),
        ("youtube:stmoritz_04", [640, 360], 0, 0, 0.01, 5),
    ],
)
def test_settings_of_the_paper(source, size, edge, force, gamma, stride):
    data = loaded(source).data
    assert data["camera"]["size"] == size and data["camera"]["edge"] == edge
    assert data["motion_filter"]["force_every"] == force
    assert data["weighting"]["prior_weight"] == gamma
    assert data["input"]["stride"] == stride and "dataset" not in data


def test_every_sequence_loads_and_says_where_its_settings_are_from():
    for name in set(table_names()) - {"kitti", "euroc"}:
        for row in load_table(name).sequences.values():
            found = loaded(row.source)
            assert found.data["camera"]["size"] != []
            assert f"datasets/{name}.yaml" in str(found.source("camera.size"))
    assert "youtube.yaml:" in str(loaded("youtube:tomyum").source("input.stride"))


def test_other_presets_and_paths_are_left_as_they_are():
    plain = load_config(preset="cpu").data["camera"]
    assert loaded("bonn:balloon", "cpu").data["camera"] == plain
    paper = load_config(preset="paper").data["camera"]
    for source in ("clip.mp4", "bon:balloon", "rgbd_bonn_balloon", "bonn:", "C:\\bonn"):
        assert loaded(source).data["camera"] == paper


def test_files_and_the_command_line_still_win(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("camera: {edge: 4}\n")
    data = loaded("bonn:balloon", "paper", "camera.size=[320,240]", files=[mine]).data
    assert data["camera"]["size"] == [320, 240] and data["camera"]["edge"] == 4
    assert data["motion_filter"]["force_every"] == 9


def test_a_dataset_can_be_extended_under_any_preset(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("extends: datasets/droidw\ninput: {source: 'droidw:downtown1'}\n")
    data = load_config([mine], preset="cpu").data
    assert data["camera"]["edge"] == 8 and "dataset" not in data
    # a source in a file brings its dataset, too
    mine.write_text("input: {source: 'tum:f2/dp'}\n")
    assert load_config([mine], preset="paper").data["camera"]["size"] == [320, 240]
