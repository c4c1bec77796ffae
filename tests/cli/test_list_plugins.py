"""`droidw list-plugins` shows what there is, what it takes, and what failed to load."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from droidw.cli.main import main
from droidw.config.load import load_config

DATA = Path(__file__).resolve().parents[1] / "plugins" / "data"


@pytest.fixture
def run(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "118")
    monkeypatch.delenv("DROIDW_LOAD_PLUGINS", raising=False)
    monkeypatch.delenv("DROIDW_DISABLE_PLUGINS", raising=False)

    def go(*arguments, code=0):
        assert main(["list-plugins", *arguments]) == code
        out, err = capsys.readouterr()
        return err if code else out

    return go


@pytest.fixture
def acme(monkeypatch):
    monkeypatch.syspath_prepend(str(DATA / "acme"))


def test_table(run):
    lines = run().splitlines()
    for kind in ("features", "depth", "uncertainty", "ba", "correspondence", "reader",
                 "exporter", "observer"):  # fmt: skip
        assert kind in lines
    (cnn,) = [line for line in lines if line.split()[:1] == ["cnn"]]
    assert cnn.split()[2] == "*"
    assert cnn.endswith("droidw 0.1.0")
    assert "failed to load" not in lines
    assert lines[-1].startswith("* default.")
    assert lines[-1].endswith("from 1 package.  Options of one: droidw list-plugins --options NAME")


def test_what_failed_is_never_hidden(run, acme):
    text = run("--kind", "depth")
    assert "features\n" not in text
    failed = text[text.index("failed to load") :].splitlines()
    (line,) = [line for line in failed if "acme-depth" in line]
    assert line.split("  ")[-2:] == [
        "ModuleNotFoundError: No module named 'acme_net_that_is_not_there'",
        "(--traceback acme-depth)",
    ]
    assert "needs droidw-acme[net]" in text


def test_from(run, acme):
    text = run("--from", "droidw-acme")
    assert "7 parts from 1 package" in text
    assert "cnn" not in text
    assert "did you mean 'droidw-acme'?" in run("--from", "droid-acme", code=2)


def test_options(run, acme):
    text = run("--options", "acme")
    assert "feature extractor acme   ready   droidw-acme 1.2" in text
    (line,) = [line for line in text.splitlines() if "features.options.scale" in line]
    assert line.split() == ["features.options.scale", "number", "1.0", ">", "0", "factor", "on",
                            "all", "features"]  # fmt: skip


def test_options_that_presets_set(run):
    chosen = load_config(preset="cpu").data["uncertainty"]["options"]
    header, *lines = run("--options", "affine-softplus").splitlines()[4:]
    said = slice(header.index("in presets"), header.index("range"))
    values = {line.split()[0].removeprefix("uncertainty.options."): line[said] for line in lines}
    assert chosen.keys() < values.keys()
    for key, value in values.items():
        assert value.strip() == (f"cpu, quick: {chosen[key]}" if key in chosen else "")
    assert "in presets" not in run("--options", "per-pixel")
    (part,) = json.loads(run("--json", "--options", "affine-softplus"))
    assert {o["key"]: o["presets"]["cpu"] for o in part["options"] if "presets" in o} == chosen


def test_options_of_a_name_of_several_kinds(run):
    assert run("--options", "none").count("it has no options") >= 3
    assert run("--options", "none", "--kind", "depth").count("it has no options") == 1


def test_options_of_nobody(run):
    assert run("--options", "cn", code=5).startswith(
        "droidw: error: --options: no part is called 'cn'\n  did you mean 'cnn'?   parts: "
    )
    assert "no depth prior is called 'cnn'" in run("--options", "cnn", "--kind", "depth", code=5)


def test_json(run, acme):
    facts = json.loads(run("--json"))
    (part,) = [p for p in facts["plugins"] if p["name"] == "acme"]
    assert part["kind"] == "features"
    assert part["status"] == "ready"
    assert (part["plugin"], part["distribution"], part["version"]) == (
        "acme-good", "droidw-acme", "1.2",
    )  # fmt: skip
    assert part["options"][0] == {
        "key": "scale", "type": "number", "default": "1.0", "limits": "> 0",
        "help": "factor on all features",
    }  # fmt: skip
    defaults = [p["name"] for p in facts["plugins"] if p["default"] and p["kind"] == "exporter"]
    assert defaults == ["depth", "ply", "trajectory", "uncertainty"]
    assert "acme-depth" in [failure["name"] for failure in facts["failures"]]
    assert json.loads(run("--json", "--options", "acme"))[0]["name"] == "acme"


def test_traceback_of_a_file(run, tmp_path):
    path = tmp_path / "bad.py"
    path.write_text("1 / 0")
    assert main(["run", "clip.mp4", "--plugin", str(path)]) == 5
    assert "Traceback (most recent call last)" in run("--plugin", str(path), "--traceback", "bad")


def test_traceback(run, acme):
    assert "acme_import_error.py" in run("--traceback", "acme-depth")
    assert "no plugin called 'cnn' failed to load" in run("--traceback", "cnn", code=2)


def test_file_plugins(run, tmp_path):
    good, bad = tmp_path / "good.py", tmp_path / "bad.py"
    good.write_text((DATA / "acme" / "acme_good.py").read_text())
    bad.write_text("import nothing_of_this_name\n")
    text = run("--plugin", str(good), "--plugin", str(bad), "--kind", "features")
    assert [line for line in text.splitlines() if line.split()[:2] == ["acme", "ready"]]
    assert "No module named 'nothing_of_this_name'" in text
    message = run("--plugin", str(bad), "--strict-plugins", code=5)
    assert message.startswith(f"droidw: error: plugin 'bad' ({bad}) failed to load:")
    assert "there is no such file" in run("--plugin", "gone.py", code=2)


def test_blocked(run, monkeypatch):
    monkeypatch.setenv("DROIDW_DISABLE_PLUGINS", "features/cnn")
    (cnn,) = [line for line in run().splitlines() if line.split()[:1] == ["cnn"]]
    assert "switched off" in cnn
