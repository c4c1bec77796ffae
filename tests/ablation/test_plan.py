"""Ablation files: what they mean, and what is refused before the first cell."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from droidw.ablation.cells import make_cells
from droidw.ablation.plan import load_plan
from droidw.config.load import load_config
from droidw.config.packaged import packaged_in
from droidw.errors import ConfigError, InputError, MissingRequirementError, UsageError
from droidw.plugin.registry import PluginNotFound

ROOM = "{a: {source: 'synthetic:static'}}"


def config(cell):
    return yaml.safe_load(cell.config)


def by_name(cells):
    return {cell.name: cell for cell in cells}


def test_rows_change_what_they_say_and_nothing_else(plan, plugins):
    found = plan(
        {
            "full": {},
            "no-uncertainty": {"uncertainty": "none"},
            "coupled": {"uncertainty": {"options": {"decoupled": False}}},
        },
        base={"device": "cpu", "camera": {"long_side": 200}},
        seeds=[3, 4],
    )
    cells, note = make_cells(found, plugins)
    assert note == "" and len(cells) == 3 * 2 * 2
    assert len({cell.digest for cell in cells}) == len(cells)
    named = by_name(cells)
    full = config(named["full/one/seed-3"])
    assert full["seed"] == 3 and full["camera"]["long_side"] == 200
    assert full["input"]["source"].endswith("data/one")
    assert Path(full["input"]["source"]).is_absolute()
    coupled = config(named["coupled/one/seed-3"])
    changed = full["uncertainty"]["options"] | {"decoupled": False}
    assert coupled == {**full, "uncertainty": {"name": "affine-softplus", "options": changed}}
    none = config(named["no-uncertainty/one/seed-3"])
    assert none == {**full, "uncertainty": {"name": "none", "options": {}}}


def test_layers_from_weak_to_strong(plan, plugins):
    found = plan(
        {"full": {}, "row": {"frontend": {"window": 30}, "uncertainty": "none"}},
        sequences=("one",),
        base={"device": "cpu", "frontend": {"window": 10, "radius": 3}, "backend": {"radius": 4}},
    )
    said = ("frontend.window=20", "uncertainty.options.lr=0.05", "threads=2")
    cells, _ = make_cells(found, plugins, said)
    full, row = (config(cell) for cell in cells)
    assert (full["frontend"]["window"], row["frontend"]["window"]) == (20, 30)
    assert full["frontend"]["radius"] == 3 and full["backend"]["radius"] == 4
    # What the command line says of a plugin falls away where the row takes another plugin.
    assert full["uncertainty"]["options"]["lr"] == 0.05
    assert row["uncertainty"] == {"name": "none", "options": {}}
    assert [cell.threads for cell in cells] == [2, 2]
    plain, _ = make_cells(found, plugins)
    assert [cell.threads for cell in plain] == [1, 1]


def test_a_seed_that_is_there_twice_counts_once(plan):
    assert plan(["full"], seeds=[1, 0, 1]).seeds == (1, 0)


def test_what_varies_with_the_seed(plan, plugins):
    found = plan(["full"], vary=["input.skip"], seeds=[0, 5])
    cells, _ = make_cells(found, plugins)
    assert [config(c)["input"]["skip"] for c in cells] == [0, 5, 0, 5]
    assert [config(c)["seed"] for c in cells] == [0, 5, 0, 5]


@pytest.mark.parametrize(
    ("vary", "seeds", "said"),
    [
        ("input.skp", [0], "plan.yaml: vary: input.skp: there is no such key"),
        ("input.skip", [0, -1], "plan.yaml: vary: input.skip: -1 is out of range"),
    ],
)
def test_what_cannot_vary_is_refused_with_the_file(plan, plugins, vary, seeds, said):
    """With the first row, whatever seed it is that does not do."""
    with pytest.raises(ConfigError) as caught:
        make_cells(plan({"full": {}, "other": {}}, vary=[vary], seeds=seeds), plugins)
    assert said in str(caught.value)


def test_a_cell_depends_on_plugin_files_and_where_datasets_lie(
    plan, plugins, tmp_path, monkeypatch
):
    file = tmp_path / "part.py"
    file.write_text("# nothing yet\n")
    found = plan(["full"])

    def digests(**more):
        return [cell.digest for cell in make_cells(found, plugins, **more)[0]]

    plain = digests()
    with_plugin = digests(plugin_files=[str(file)])
    assert not set(plain) & set(with_plugin)
    file.write_text("# something else\n")
    assert not set(with_plugin) & set(digests(plugin_files=[str(file)]))
    # Where folders of pictures lie is in the configuration already; rendered ones lie nowhere.
    assert digests(data=tmp_path / "elsewhere") == plain
    dataset = tmp_path / "p.yaml"
    dataset.write_text(
        "preset: paper\nsequences: {a: {source: 'bonn:balloon'}, b: {source: 'synthetic:orbit'}}\n"
        "rows: {full: {features: none, depth: none, uncertainty: none, correspondence: flow}}\n"
    )
    found = load_plan(str(dataset))
    places = [{}, {"data": tmp_path}, {"data": tmp_path / "elsewhere"}]
    balloon, orbit = zip(*(digests(**place) for place in places), strict=True)
    assert (len(set(balloon)), len(set(orbit))) == (3, 1)
    monkeypatch.setenv("DROIDW_DATA", str(tmp_path / "elsewhere"))
    assert digests()[0] == balloon[2]


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("vary: [input]", "vary: 'input' cannot be set to a seed"),
        ("vary: [input.source]", "vary: 'input.source' cannot be set to a seed"),
        ("measure: {t_max_diff: .inf}", "measure.t_max_diff: inf is not a number from 0"),
    ],
)
def test_what_no_cell_could_be_made_with_is_refused(tmp_path, lines, said):
    file = tmp_path / "p.yaml"
    file.write_text(f"preset: cpu\nsequences: {ROOM}\nrows: {{full: {{}}}}\n{lines}\n")
    with pytest.raises(ConfigError, match=re.escape(said)):
        load_plan(str(file))


def test_a_row_whose_input_is_no_section_is_refused(tmp_path, plugins):
    file = tmp_path / "p.yaml"
    file.write_text(f"preset: cpu\nsequences: {ROOM}\nrows: {{full: {{input: x}}}}\n")
    with pytest.raises(ConfigError, match=re.escape("rows.full: input: 'x' is no section")):
        make_cells(load_plan(str(file)), plugins)


def test_sequences_with_settings_and_sources(tmp_path, plugins):
    (tmp_path / "footage" / "a").mkdir(parents=True)
    file = tmp_path / "p.yaml"
    file.write_text(
        "preset: cpu\n"
        "sequences:\n"
        "  first: {source: a, camera: {fov: 70}}\n"
        "  orbit: {source: 'synthetic:orbit', vary: [reader.options.seed], reader: synthetic}\n"
        "vary: input.skip\n"
        "rows: {full: {}}\n"
        "base: {device: cpu}\n"
    )
    found = load_plan(str(file), data=tmp_path / "footage")
    cells, _ = make_cells(found, plugins, preset=None)
    first, orbit = (config(cell) for cell in cells)
    assert first["camera"]["fov"] == 70 and orbit["camera"]["fov"] is None
    assert first["input"] == {**orbit["input"], "source": str(tmp_path / "footage" / "a")}
    assert orbit["input"]["source"] == "synthetic:orbit"
    chosen = load_plan(str(file), tmp_path / "footage", ["orbit", "synthetic:static"], seeds=[7])
    assert list(chosen.sequences) == ["orbit", "synthetic-static"]
    assert chosen.sequences["synthetic-static"].source == "synthetic:static"
    cells, _ = make_cells(chosen, plugins)
    assert config(cells[0])["reader"]["options"]["seed"] == 7
    assert (config(cells[1])["input"]["skip"], cells[1].seed) == (7, 7)


def test_names_of_sequences_stay_apart(tmp_path):
    """Each has a folder of cells of its own, and none lies outside of the ablation's."""
    file = tmp_path / "p.yaml"
    file.write_text("rows: {full: {}}\n")
    names = ["my clip", "my-clip", "a/b", "a-b", "日本", "韓国", "..", ".hidden"]
    found = load_plan(str(file), tmp_path, names).sequences
    assert [Path(f.source).name for f in found.values()] == [n.split("/")[-1] for n in names]
    assert list(found)[:2] == ["my-clip", next(k for k in found if k.startswith("my-clip-"))]
    assert all(name[0].isalnum() and "/" not in name for name in found)
    assert list(load_plan(str(file), tmp_path, ["a", "b", "a"]).sequences) == ["a", "b"]


@pytest.mark.parametrize(
    ("row", "more", "said"),
    [
        ({"seed": 4}, {}, "rows.r: seed cannot be set for cells"),
        ({"input": {"source": "x"}}, {}, "rows.r: input.source cannot be set for cells"),
        ({"input": {"skip": 3}}, {"vary": ["input.skip"]}, "rows.r: input.skip cannot be set"),
        ({}, {"base": {"seed": 1}}, "base: seed cannot be set for cells"),
    ],
)
def test_what_every_cell_has_of_its_own_is_refused(plan, plugins, row, more, said):
    with pytest.raises(ConfigError, match="cannot be set for cells") as caught:
        make_cells(plan({"full": {}, "r": row}, **more), plugins)
    where = str(caught.value)
    assert where.split(": ")[0].rpartition(":")[0].endswith("plan.yaml") or "base" in where
    assert said.split(": ")[1] in where


def test_a_seed_that_is_none_is_told_with_the_file(plan, plugins):
    with pytest.raises(ConfigError, match=r"plan\.yaml: seeds: seed: -1 is out of range"):
        make_cells(plan(["full"], seeds=[-1]), plugins)


def test_a_seed_on_the_command_line_is_refused(plan, plugins):
    with pytest.raises(ConfigError, match="seed cannot be set for cells") as caught:
        make_cells(plan(["full"]), plugins, ("seed=3",))
    assert "--seeds" in caught.value.hint


def test_each_sequence_of_a_dataset_has_its_own_settings(tmp_path, plugins):
    file = tmp_path / "p.yaml"
    file.write_text(
        "preset: paper\nsequences: {a: {source: 'bonn:balloon'}, b: {source: 'tum:f3_walking'}}\n"
        "rows: {full: {features: none, depth: none, uncertainty: none, correspondence: flow}}\n"
    )
    cells, _ = make_cells(load_plan(str(file)), plugins)
    found = {config(cell)["input"]["source"]: config(cell)["camera"] for cell in cells}
    for source, camera in found.items():
        alone = load_config(preset="paper", values={"input.source": source}).data["camera"]
        assert {key: camera[key] for key in alone} == alone
    one, other = found.values()
    assert one != other


def test_an_unknown_plugin_is_refused_with_its_row(plan, plugins, tmp_path):
    found = plan({"full": {}, "swap": {"uncertainty": "afine-softplus"}})
    with pytest.raises(PluginNotFound) as caught:
        make_cells(found, plugins)
    said = str(caught.value)
    assert "plan.yaml:" in said and "rows.swap: uncertainty.name: no uncertainty model" in said
    assert "did you mean 'affine-softplus'?" in said
    assert sorted(p.name for p in tmp_path.iterdir()) == ["data", "plan.yaml"]


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ({"frontend": {"windw": 3}}, "rows.bad: frontend.windw"),
        ({"uncertainty": {"options": {"weight_decay": "much"}}}, "rows.bad: uncertainty.options"),
        ({"uncertainty": {"options": {"weight_decay": -1}}}, "weight_decay"),
        ({"features": "none"}, "needs features"),
        ({"schedule": {"windo": {"updates": 1}}}, "schedule.windo: there is no such phase"),
    ],
)
def test_a_row_that_does_not_fit_is_refused(plan, plugins, row, said):
    with pytest.raises(ConfigError) as caught:
        make_cells(plan({"full": {}, "bad": row}), plugins)
    assert said in str(caught.value)


def test_a_row_that_cannot_run_here_is_kept_and_told(plan, plugins):
    found = plan({"full": {}, "file": {"depth": "file"}, "droid": {"correspondence": "droid"}})
    cells, _ = make_cells(found, plugins)
    missing = {cell.row for cell in cells if cell.missing}
    assert missing == {"droid"}
    assert all("weights" in cell.missing for cell in cells if cell.row == "droid")
    only = plan({"droid": {"correspondence": "droid"}})
    with pytest.raises(MissingRequirementError, match="droid"):
        make_cells(only, plugins)


def test_sequences_that_are_not_there(plan, plugins):
    found = plan(["full"])
    (Path(found.sequences["two"].source)).rmdir()
    with pytest.raises(InputError, match=r"of 2 sequences, 1 are not there: two \("):
        make_cells(found, plugins)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("row: {}\n", "row: no ablation has this key"),
        ("rows: [a]\n", "rows: ['a'] is no mapping"),
        ("rows: {a/b: {}}\n", "cannot be the name of a folder"),
        ("rows: {a: 3}\n", "rows.a: 3 is no mapping"),
        ("rows: {a: {}}\n", "sequences: there is none"),
        ("sequences: [x]\n", "rows: there is none"),
        ("rows: {a: {}}\nsequences: [x]\nseeds: [a]\n", "seeds: ['a'] is no list of whole numbers"),
        ("rows: {a: {}}\nsequences: []\n", "sequences: there is none"),
        ("rows: {a: {}}\nsequences: [x]\npreset: cpuu\n", ":3: preset: no preset is called 'cpuu'"),
        ("rows: {a: {}}\nsequences: [x]\nmeasure: {align: sim2}\n", "measure.align: 'sim2'"),
        ("rows: {a: {}}\nsequences: [x]\nmeasure: {after: 2}\n", "measure.after: there is no such"),
        ("rows: {a: {}}\nsequences: [x]\nneeds: {gpu: 1}\n", "needs.gpu"),
        ("rows: {a: {}}\nsequences: [x]\nconfig: nowhere\n", "there is no file or packaged config"),
        ("rows: {a: {}\n", "is not YAML"),
    ],
)
def test_files_that_are_no_ablation(tmp_path, text, said):
    file = tmp_path / "p.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_plan(str(file))
    assert said in str(caught.value) and "p.yaml" in str(caught.value)


def test_names_that_are_not_there():
    with pytest.raises(UsageError, match="'cpuu' is neither a file nor an ablation"):
        load_plan("cpuu")
    with pytest.raises(ConfigError, match="there is no such configuration file"):
        load_plan("nowhere/cpu.yaml")
    with pytest.raises(UsageError, match="has no row 'ful'") as caught:
        load_plan("demo", rows=["ful"])
    assert "did you mean 'full'?" in caught.value.hint


PUBLISHED = {
    "a-no-uncertainty": {"uncertainty": "none"},
    "b-no-depth": {"depth": "none"},
    "c-no-decoupling": {"uncertainty": {"options": {"decoupled": False}}},
    "d-no-affine-map": {"uncertainty": "per-pixel"},
    "e-no-weight-decay": {"uncertainty": {"options": {"weight_decay": 0}}},
    "no-prior": {"uncertainty": {"options": {"gamma_prior": 0}}},
}
"""Rows of the paper's two ablation tables."""


def test_every_published_row_is_a_row_of_paper():
    rows = {name: tree for name, (_, tree) in load_plan("paper").rows.items()}
    assert next(iter(rows)) == "full" and rows["full"] == {}
    assert {name: rows.get(name) for name in PUBLISHED} == PUBLISHED
    for slot, names in {
        "features": {"dinov2", "cnn"},
        "uncertainty": {"per-pixel", "mlp", "none"},
        "ba": {"cuda", "torch", "native"},
        "depth": {"none"},
    }.items():
        assert names <= {tree[slot] for tree in rows.values() if isinstance(tree.get(slot), str)}
    assert load_plan("paper").preset == "paper"


@pytest.mark.parametrize("name", packaged_in("ablations"))
def test_packaged_ablations_resolve(name, plugins, tmp_path):
    """Every row names plugins and options that exist, whether or not they can run here."""
    found = load_plan(name, data=tmp_path)
    for footage in found.sequences.values():
        if ":" not in footage.source:
            Path(footage.source).mkdir(exist_ok=True)
    try:
        cells, _ = make_cells(found, plugins)
    except MissingRequirementError:
        assert name == "paper"  # its parts want weights, which no test has
        return
    assert cells and {cell.row for cell in cells} == set(found.rows)


def test_sequences_whose_names_are_digits(tmp_path):
    for name in ("00", "010", "08"):
        (tmp_path / "data" / name).mkdir(parents=True)
    file = tmp_path / "a.yaml"
    file.write_text("preset: cpu\ndata: data\nsequences: [00, 010, 08]\nrows: {full: {}}\n")
    assert list(load_plan(str(file)).sequences) == ["00", "010", "08"]
    file.write_text("preset: cpu\ndata: data\nsequences: {a: {source: 010}}\nrows: {full: {}}\n")
    assert Path(load_plan(str(file)).sequences["a"].source).name == "010"
