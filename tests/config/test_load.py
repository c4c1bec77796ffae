"""Layers, `extends`, shorthand, overrides, and where each key came from."""

from __future__ import annotations

import dataclasses

import pytest

from droidw.config.load import load_config
from droidw.config.packaged import packaged_configs
from droidw.config.schema import DroidwConfig
from droidw.errors import ConfigError, UsageError


@pytest.fixture
def write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def make(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return make


def refusal(*args, error=ConfigError, **more):
    with pytest.raises(error) as caught:
        load_config(*args, **more)
    return str(caught.value)


def test_nothing_given_is_the_schema():
    loaded = load_config()
    assert loaded.data == dataclasses.asdict(DroidwConfig())
    assert loaded.sources == {}


def test_each_layer_beats_the_one_before(write):
    write("common.yaml", "seed: 1\nthreads: 1\ncamera: {edge: 1, long_side: 100}\n")
    mine = write("mine.yaml", "extends: common\nthreads: 2\ncamera:\n  long_side: 200\n")
    write("preset.yaml", "seed: 9\nfiller: {batch: 9}\n")
    loaded = load_config([mine], preset="preset.yaml", overrides=["camera.long_side=300"])
    assert loaded.data["seed"] == 1
    assert loaded.data["threads"] == 2
    assert loaded.data["filler"]["batch"] == 9
    assert loaded.data["camera"] == {
        **dataclasses.asdict(DroidwConfig().camera), "edge": 1, "long_side": 300
    }  # fmt: skip
    assert loaded.files == ("preset.yaml", "common.yaml", "mine.yaml")
    assert str(loaded.source("threads")) == "mine.yaml:2"
    assert str(loaded.source("camera.edge")) == "common.yaml:3"
    assert str(loaded.source("camera.long_side")) == "command line"
    assert loaded.source("device") is None
    assert loaded.at("seed") == "common.yaml:1: seed"


def test_extends_takes_packaged_names_and_lists(write):
    mine = write("mine.yaml", "extends: [presets/paper, sub/more.yaml]\n")
    write("sub/more.yaml", "extends: ../common.yaml\nseed: 3\n")
    write("common.yaml", "ba: torch\n")
    loaded = load_config([mine])
    assert loaded.data["features"]["name"] == "fit3d"
    assert loaded.data["ba"]["name"] == "torch"
    assert loaded.data["seed"] == 3


def test_extends_in_a_circle(write):
    write("a.yaml", "extends: b\n")
    write("b.yaml", "extends: c\n")
    write("c.yaml", "extends: b\n")
    assert refusal(["a.yaml"]) == (
        "b.yaml: extends: the files extend each other: b.yaml -> c.yaml -> b.yaml"
    )


def test_a_file_may_be_extended_twice(write):
    write("base.yaml", "seed: 1\n")
    write("b.yaml", "extends: ./base.yaml\n")
    mine = write("mine.yaml", "extends: [b, ./base.yaml]\n")
    assert load_config([mine]).data["seed"] == 1


def test_extends_of_nothing(write):
    mine = write("mine.yaml", "seed: 1\nextends: presets/papr\n")
    message = refusal([mine])
    assert message.startswith(
        "mine.yaml:2: extends: there is no file or packaged config 'presets/papr'\n"
        "  did you mean 'presets/paper'?   packaged: "
    )
    write("mine.yaml", "extends: 3\n")
    assert refusal([mine]).startswith(
        "mine.yaml:1: extends: 3 is neither a name nor a list of names"
    )


def test_shorthand_of_a_slot(write):
    mine = write("mine.yaml", "uncertainty: mlp\ndepth: {name: net}\n")
    data = load_config([mine]).data
    assert data["uncertainty"] == {"name": "mlp", "options": {}}
    assert data["depth"] == {"name": "net", "options": {}}


def test_another_plugin_resets_the_options(write):
    mine = write("mine.yaml", "uncertainty: {name: mlp, options: {lr: 0.3}}\n")
    same = load_config([mine], overrides=["uncertainty=mlp", "uncertainty.options.decay=1"])
    assert same.data["uncertainty"]["options"] == {"lr": 0.3, "decay": 1}
    other = load_config([mine], overrides=["uncertainty=affine-softplus"])
    assert other.data["uncertainty"] == {"name": "affine-softplus", "options": {}}
    assert "uncertainty.options.lr" not in other.sources


def test_overrides_choose_before_they_set():
    for order in (1, -1):
        overrides = ["uncertainty.options.lr=0.2", "uncertainty=mlp"][::order]
        data = load_config(overrides=overrides).data
        assert data["uncertainty"] == {"name": "mlp", "options": {"lr": 0.2}}


def test_exporters_add_up_and_can_be_switched_off(write):
    mine = write("mine.yaml", "exporters: {colmap: {}, ply: null}\n")
    loaded = load_config([mine], overrides=["exporters.csv={}"])
    assert loaded.data["exporters"] == {
        "trajectory": {}, "ply": None, "uncertainty": {}, "depth": {}, "colmap": {}, "csv": {},
    }  # fmt: skip
    assert load_config(overrides=["exporters=[ply]"]).data["exporters"] == {"ply": {}}
    assert load_config(overrides=["exporters=null"]).data["exporters"] == {}
    blank = write("blank.yaml", "exporters:\n  # ply:\n")
    assert load_config([blank]).data["exporters"] == load_config().data["exporters"]


def test_values_of_flags_are_taken_as_they_are():
    loaded = load_config(values={"input.source": "a: 1.mp4", "seed": 3}, overrides=["seed=4"])
    assert loaded.data["input"]["source"] == "a: 1.mp4"
    assert loaded.data["seed"] == 4


def test_numbers_with_an_exponent_are_numbers():
    data = load_config(overrides=["solver.lm=1e-3", "input.source='1e-3'"]).data
    assert data["solver"]["lm"] == 1e-3
    assert data["input"]["source"] == "1e-3"


def test_an_empty_section_changes_nothing(write):
    mine = write("mine.yaml", "camera:\n#  edge: 3\n")
    assert load_config([mine]).data == load_config().data
    assert load_config([write("empty.yaml", "# nothing\n")]).data == load_config().data


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("depth: off\n", "mine.yaml:1: depth: false is not the name of a plugin\n  write depth: "
                         "NAME, or depth: {name: NAME, options: {...}}; what is to be off is "
                         "called none\n  see: droidw list-plugins --kind depth"),
        ("\ndepth:\n  name: 3\n", "mine.yaml:3: depth.name: 3 is not the name of a plugin\n"
                                  "  see: droidw list-plugins --kind depth"),
        ("seed: 1\nseed: 2\n", "mine.yaml:2: seed: is written twice in this file"),
        ("- 3\n", "mine.yaml: a configuration holds `key: value` lines, not a bare value"),
    ],
)  # fmt: skip
def test_files_that_are_refused(write, text, message):
    assert refusal([write("mine.yaml", text)]) == message


def test_files_that_cannot_be_read(write):
    assert refusal(["gone.yaml"]) == "gone.yaml: there is no such configuration file"
    assert "mine.yaml: is not YAML: while parsing" in refusal([write("mine.yaml", "a: [1\n")])
    path = write("mine.yaml", "")
    path.write_bytes(b"\xff\xfe\xff")
    assert "mine.yaml: cannot be read" in refusal([path])


def test_overrides_that_are_refused():
    assert refusal(overrides=["clip.mp4"], error=UsageError) == (
        "command line: 'clip.mp4' is not key=value\n"
        "  example: camera.long_side=512   or   uncertainty=none"
    )
    assert "is not key=value" in refusal(overrides=["a..b=1"], error=UsageError)
    assert "is not YAML" in refusal(overrides=["seed=[1"], error=UsageError)
    said = refusal(overrides=["camera.long_side=2024-13-45"], error=UsageError)
    assert "camera.long_side: the value '2024-13-45' is not YAML: month must be in 1..12" in said


@pytest.mark.parametrize(
    "text", ["seed: 1\ncamera: {long_side: 2024-13-01}\n", "seed: !foo 3\n", "camera: &a {x: *a}\n"]
)
def test_values_that_are_none(write, text):
    assert "holds what is no value: " in refusal([write("mine.yaml", text)])


def test_unknown_preset():
    assert refusal(preset="papr", error=UsageError) == (
        "--preset: no preset is called 'papr'\n"
        "  did you mean 'paper'?   presets: cpu, droid-slam, paper, quick, auto"
    )


def test_every_packaged_config_loads():
    for path in packaged_configs().values():
        if path.parent.name != "ablations":
            load_config([path])
