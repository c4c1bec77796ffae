"""What is refused, in which words, and what comes out when all fits."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest
import yaml

import droidw
from droidw.config.load import load_config
from droidw.config.resolve import choose_preset, needs_preset, resolve
from droidw.config.schema import DroidwConfig
from droidw.errors import ConfigError, MissingRequirementError, PluginError
from droidw.plugin.registry import PluginNotFound


def test_defaults_resolve(resolved):
    done = resolved()
    assert set(done.parts) == {"features", "depth", "uncertainty", "ba", "correspondence"}
    names = [part.name for part, _ in done.exporters]
    assert names == ["trajectory", "ply", "uncertainty", "depth"]
    assert [part.name for part, _ in done.observers] == ["progress", "report"]
    assert done.devices == {"cpu"}  # `flow` of these tests knows no other
    assert isinstance(done.config, DroidwConfig)
    assert done.config.uncertainty.options["lr"] == 0.1


def test_options_are_frozen_dataclasses_of_their_part(resolved):
    done = resolved("uncertainty.options={lr: 1e-2, taps: [1, 2], path: some/file}", "reader=video")
    options = done.parts["uncertainty"][1]
    assert (options.lr, options.taps, options.path) == (0.01, (1, 2), Path("some/file"))
    with pytest.raises(dataclasses.FrozenInstanceError):
        options.lr = 2
    assert done.parts["reader"][0].name == "video"


def test_an_exporter_that_is_switched_off(resolved):
    done = resolved("exporters.ply=null", "observers=[report]")
    assert [part.name for part, _ in done.exporters] == ["trajectory", "uncertainty", "depth"]
    assert [part.name for part, _ in done.observers] == ["report"]


def test_round_trip(resolved, tmp_path):
    first = resolved(
        "uncertainty.options={lr: 1e-2, taps: [1, 2], path: a/b, side: right}",
        "exporters.ply=null", "camera.size=[320, 240]", "schedule.window.updates=7",
        "global_solver.lm=1e-7",
        "input.source='a: 1'",
    )  # fmt: skip
    path = tmp_path / "config.yaml"
    path.write_text(first.to_yaml())
    second = resolved(files=[path])
    assert second.config == first.config
    assert second.parts == first.parts
    assert [part.name for part, _ in second.exporters] == ["trajectory", "uncertainty", "depth"]
    assert second.to_yaml() == first.to_yaml()
    assert yaml.safe_load(first.to_yaml())["uncertainty"]["options"]["taps"] == [1, 2]
    assert "# ba: auto, from registered from Python" in first.to_yaml()


@pytest.mark.parametrize(
    ("override", "kept"),
    [
        ("exporters=null", []),
        ("exporters={}", []),
        ("exporters=[mapped]", ["mapped"]),
        ("exporters.ply=null", ["trajectory", "uncertainty", "depth"]),
    ],
)
def test_what_is_off_stays_off_in_what_is_kept_of_a_run(resolved, tmp_path, override, kept):
    first = resolved(override, "observers=null", "input.source=x")
    path = tmp_path / "config.yaml"
    path.write_text(first.to_yaml())
    second = resolved(files=[path])
    assert [part.name for part, _ in first.exporters] == kept
    assert [part.name for part, _ in second.exporters] == kept
    assert second.observers == first.observers == ()
    assert not needs_preset([path])
    assert second.to_yaml() == first.to_yaml()


def test_a_mapping_of_options_is_what_it_is_said_to_be(resolved, tmp_path):
    first = resolved("exporters={mapped: {scale: {far: 2, near: 3}}}")
    assert first.exporters[-1][1].scale == {"far": 2.0, "near": 3.0}
    path = tmp_path / "config.yaml"
    path.write_text(resolved("exporters=[mapped]").to_yaml())
    assert resolved(files=[path]).exporters[-1][1].scale == {"near": 1.0}
    path.write_text("exporters: {mapped: {scale: {far: 2}}}")  # keys that are left out are gone
    assert resolved(files=[path]).exporters[-1][1].scale == {"far": 2.0}
    with pytest.raises(ConfigError, match="scale"):
        resolved("exporters.mapped.scale={far: deep}")


def test_names_of_digits_are_names(resolved, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("input: {source: 010, masks: 12:30}\ncamera: {calib: null}\n")
    config = resolved(files=[path]).config
    assert (config.input.source, config.input.masks, config.camera.calib) == ("010", "12:30", None)
    assert resolved("input.source=00").config.input.source == "00"


PHASES = ", ".join(DroidwConfig().schedule)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("camera.long_sid=3",
         "camera.long_sid: there is no such key\n  did you mean 'camera.long_side'?   "
         "keys of camera: calib, focal, fov, long_side, size, edge, refine_focal, "
         "focal_trust, focal_slack, focal_range"),
        ("camera.long_side=big",
         "camera.long_side: 'big' is not valid here\n  expected: whole number"),
        ("camera.fov=200", "camera.fov: 200.0 is out of range\n  valid: > 1 and < 179"),
        ("camera.fov=.nan", "camera.fov: nan is not a finite number\n  valid: > 1 and < 179"),
        ("camera={calib: a.txt, fov: 60}",
         "camera.fov: calib and fov are given, but only one of them can hold\n  give one of "
         "--calib FILE, --focal PIXELS, --fov DEGREES; one that a file sets is off with "
         "camera.calib=null"),
        ("weighting={min_disp: 2, max_disp: 1}",
         "weighting.max_disp: 1 is not more than weighting.min_disp, 2, and nothing lies between\n"
         "  valid: a larger one, or 0 for none"),
        ("camera.size=[3]",
         "camera.size: [3] is not a working size\n  valid: [width, height], each at least 32, "
         "or [] to follow camera.long_side"),
        ("camera=3",
         "camera: 3 is not valid here\n  expected a section with keys: calib, focal, fov, "
         "long_side, size, edge, refine_focal, focal_trust, focal_slack, focal_range"),
        ("weighting.gate=step",
         "weighting.gate: 'step' is not valid here\n  expected: one of rational, inverse, none"),
        ("backend.passes=[7, a]",
         "backend.passes.1: 'a' is not valid here\n  expected: whole number"),
        ("schedule.windw.updates=3",
         "schedule.windw: there is no such phase\n  did you mean 'schedule.window'?   "
         f"phases: {PHASES}"),
        ("schedule.global.updates=3",
         "schedule.global.updates: this key changes nothing\n  how many there are is set by "
         "backend.passes; leave it out"),
        ("filler_solver.guard=true",
         "filler_solver.guard: this key changes nothing\n  each frame between keyframes is "
         "adjusted by itself; leave it out"),
        ("schedule.window.updates=-1", "schedule.window.updates: -1 is out of range\n"
                                       "  valid: >= 0"),
        ("schedule.window=3", "schedule.window: 3 is not valid here\n  expected a section with "
                              "keys: updates, iterations, learn, weigh, depth_prior"),
        ("device=gpu",
         "device: 'gpu' is not a device\n  valid: auto, cpu, cuda, cuda:0, cuda:1, ..."),
        ("device=cuda",
         "device: correspondence 'flow' does not run on cuda\n  it runs on: cpu; choose another "
         "device, or correspondence=net"),
        ("compat=[droidw]",
         "compat: no published behaviour is called 'droidw'\n  did you mean 'droid-w'?   "
         "valid: droid-w"),
        ("uncertainty.lr=0.1",
         "uncertainty.lr: there is no such key\n  keys of uncertainty: name, options\n"
         "  options of the plugin go below uncertainty.options"),
        ("uncertainty.options.l_r=0.1",
         "uncertainty.options.l_r: there is no such key\n  did you mean 'uncertainty.options.lr'?"
         "   keys of uncertainty.options: lr, mode, taps, path, side"),
        ("uncertainty.options.lr=2",
         "uncertainty.options.lr: 2.0 is out of range\n  valid: > 0 and <= 1"),
        ("uncertainty.options.mode=off",
         "uncertainty.options.mode: False is not valid here\n"
         "  expected: one of online, frozen"),
        ("uncertainty.options={mode: frozen, taps: [1, 2]}",
         "uncertainty.options: mode 'frozen' takes one tap"),
        ("features.options.x=1",
         "features.options.x: there is no such key\n  keys of features.options: none"),
        ("exporters.ply.binry=1",
         "exporters.ply.binry: there is no such key\n  did you mean 'exporters.ply.binary'?   "
         "keys of exporters.ply: binary"),
        ("exporters.ply=3",
         "exporters.ply: 3 is neither a mapping of options nor null\n"
         "  exporters.ply={} switches it on, exporters.ply=null off"),
        ("reader.options.a=1",
         "reader.options.a: `auto` has no options\n"
         "  name the reader that they are for: reader=NAME"),
    ],
)  # fmt: skip
def test_refusals(resolved, override, message):
    with pytest.raises(ConfigError) as caught:
        resolved(override)
    assert str(caught.value) == "command line: " + message
    assert caught.value.exit_code == 2


def test_refusals_name_file_and_line(resolved, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my.yaml").write_text("seed: 1\nuncertainty:\n  name: afine-softplus\n")
    with pytest.raises(PluginNotFound) as caught:
        resolved(files=["my.yaml"])
    assert str(caught.value) == (
        "my.yaml:3: uncertainty.name: no uncertainty model is called 'afine-softplus'\n"
        "  did you mean 'affine-softplus'?   available: affine-softplus, mlp, none\n"
        "  see: droidw list-plugins --kind uncertainty"
    )


def test_parts_that_cannot_run_are_named_together(resolved):
    with pytest.raises(MissingRequirementError) as caught:
        resolved("depth=net", "exporters.plx={}")
    assert str(caught.value) == (
        "command line: depth.name: 'net' is registered but cannot run: Python package "
        "'acme_net' is missing\n"
        "  install it: pip install acme_net\n"
        "  or run without: depth=none\n"
        "  also: command line: exporters.plx: no exporter is called 'plx'"
    )


def test_model_that_needs_features(resolved):
    with pytest.raises(ConfigError) as caught:
        resolved("features=none")
    assert str(caught.value) == (
        "uncertainty.name: 'affine-softplus' needs features, and the feature extractor 'none' "
        "gives none\n  choose another extractor (features=NAME), or run without uncertainty: "
        "uncertainty=none; a plugin says that it gives some by capabilities={'cpu', 'features'} in "
        "its Component"
    )
    assert resolved("features=none", "uncertainty=none").parts["features"][0].name == "none"


def test_parts_without_a_common_device(resolved):
    with pytest.raises(ConfigError) as caught:
        resolved("ba=cuda")
    assert str(caught.value).startswith(
        "correspondence.name: 'flow' runs only on cpu, where not all other parts do"
    )
    assert resolved("ba=cuda", "correspondence=net").devices == {"cuda"}


def test_the_advice_is_to_switch_off_what_the_file_says(plugins, tmp_path):
    (tmp_path / "mine.yaml").write_text("camera: {fov: 60}\n")
    loaded = load_config([tmp_path / "mine.yaml"], "cpu", ["camera.focal=300"])
    with pytest.raises(ConfigError, match="focal and fov are given") as caught:
        resolve(loaded, plugins)
    assert caught.value.hint.endswith("with camera.fov=null")


def test_a_seed_has_a_largest_value(resolved):
    with pytest.raises(ConfigError, match="seed: 99999999999 is out of range"):
        resolved("seed=99999999999")


def test_options_of_a_type_that_yaml_cannot_hold(resolved):
    with pytest.raises(PluginError, match=r"reader\.options: the options OddOptions hold a type"):
        resolved("reader=odd")


def test_preset_paper_names_each_part_that_is_missing(resolved):
    with pytest.raises(PluginNotFound) as caught:
        resolved(preset="paper")
    text = str(caught.value)
    assert "configs/presets/paper.yaml:" in text.splitlines()[0]
    assert text.endswith("preset 'paper' names these parts; --preset auto takes what can run here")
    for name in ("fit3d", "metric3d", "droid"):
        assert f"is called '{name}'" in text


def test_preset_auto(plugins):
    assert choose_preset(plugins) == (
        "cpu",
        "preset cpu, since paper lacks features 'fit3d' (not installed), depth 'metric3d' (not "
        "installed), correspondence 'droid' (not installed)",
    )
    for kind, name in (("features", "fit3d"), ("depth", "metric3d"), ("correspondence", "droid")):
        plugins.add(kind, droidw.Component(name, "", print))
    assert choose_preset(plugins)[0] == "paper"


def test_preset_cpu_is_the_default_but_for_what_its_features_need():
    plugins = droidw.load_plugins(environ={})
    chosen = resolve(load_config(preset="cpu"), plugins)
    default = resolve(load_config(), plugins)
    assert chosen.preset == "cpu"
    assert chosen.config.uncertainty.name == default.config.uncertainty.name
    assert chosen.config.uncertainty.options["lr"] == 0.3
    chosen.config.uncertainty.options = default.config.uncertainty.options
    assert chosen.config == default.config


def test_nothing_heavy_is_loaded_to_refuse(plugins):
    import subprocess

    code = (
        "import sys\nfrom droidw.cli.options import plugins_from\n"
        "from droidw.config.load import load_config\nfrom droidw.config.resolve import resolve\n"
        "import droidw\ntry:\n resolve(load_config(overrides=['camera.fov=500']), "
        "droidw.load_plugins())\nexcept droidw.errors.ConfigError as e: pass\n"
        "print([m for m in ('torch', 'cv2') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
