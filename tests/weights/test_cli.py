"""`droidw weights` as it is typed, and what other commands say of weights."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from droidw.cli.main import main
from droidw.cli.transfer import Bar, amount

PLUGIN = ["--plugin", str(Path(__file__).with_name("acme_weights.py"))]


@pytest.fixture(autouse=True)
def _folder(monkeypatch, tmp_path, site):
    monkeypatch.setenv("DROIDW_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("DROIDW_LOAD_PLUGINS", "")
    monkeypatch.setenv("ACME_URL", site.root)


@pytest.fixture
def published(site, tmp_path):
    state = {"conv.weight": torch.ones(4, 3, 3, 3), "conv.bias": torch.zeros(4)}
    torch.save(state, tmp_path / "acme.pth")
    site.serve("/acme_v2.pth", (tmp_path / "acme.pth").read_bytes())
    return tmp_path / "acme.pth"


def listed(capsys):
    assert main(["weights", "list", "--json", *PLUGIN]) == 0
    facts = json.loads(capsys.readouterr().out)
    return facts["folder"], {row["name"]: row for row in facts["weights"]}


def test_list_names_size_licence_and_place(capsys, tmp_path):
    folder, rows = listed(capsys)
    assert folder == str(tmp_path / "weights")
    assert rows["acme-small"] | {"recorded": None} == {
        "name": "acme-small", "needed_by": ["depth acme"], "distribution": PLUGIN[1],
        "present": False, "path": "", "size": 1000, "licence": "CC BY-NC 4.0",
        "published_file": "acme_v2.pth", "published_sha256": "",
        "urls": rows["acme-small"]["urls"], "reference": "acme.example", "recorded": None,
    }  # fmt: skip
    built_in = {"fit3d", "dinov2-vits14-reg", "metric3d-vit-small", "metric3d-vit-large"}
    assert built_in <= set(rows)
    assert all(rows[name]["urls"] and rows[name]["licence"] for name in built_in)
    assert main(["weights", "list", *PLUGIN]) == 0
    text = capsys.readouterr().out
    assert "acme-small" in text and "~1.0 kB" in text and "CC BY-NC 4.0" in text
    assert f"folder: {folder}" in text and "fit3d" in text
    assert main(["weights", "list", "acme-small", *PLUGIN]) == 0
    text = capsys.readouterr().out
    assert "acme-small" in text and "fit3d" not in text


def test_fetch_then_list_then_verify(capsys, published):
    assert main(["weights", "fetch", "acme-small", *PLUGIN]) == 0
    out = capsys.readouterr().out
    assert "stored as" in out and "licence: CC BY-NC 4.0" in out
    _, rows = listed(capsys)
    assert rows["acme-small"]["present"] and rows["acme-small"]["recorded"]["published_sha256"]
    assert main(["list-plugins", "--options", "acme", *PLUGIN]) == 0
    assert "depth prior acme   ready" in capsys.readouterr().out
    assert main(["weights", "verify", *PLUGIN]) == 0
    assert "acme-small: ok" in capsys.readouterr().out
    assert main(["weights", "fetch", "acme-small", *PLUGIN]) == 0
    assert "is there and verified" in capsys.readouterr().out
    Path(rows["acme-small"]["path"]).write_bytes(b"rubbish")
    assert main(["weights", "verify", *PLUGIN]) == 3
    assert "BAD" in capsys.readouterr().out


def test_add_and_its_folder(capsys, published, tmp_path):
    assert main(["weights", "add", str(published), "--folder", str(tmp_path / "w"), *PLUGIN]) == 0
    assert "is 'acme-small' and fits" in capsys.readouterr().out
    assert (tmp_path / "w" / "acme-small.safetensors").is_file()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["fetch"], 2, "no NAME is given"),
        (["fetch", "acme-smal"], 2, "did you mean 'acme-small'"),
        (["fetch", "acme-small", "--offline"], 5, "--offline forbids"),
        (["fetch", "acme-big"], 3, "published at no address"),
        (["add"], 2, "no FILE is given"),
        (["add", "nowhere.pth"], 2, "no such file"),
        (["add", "a", "b", "--name", "acme-big"], 2, "one at a time"),
        (["verify", "acme-big"], 2, "acme-big: MISSING: the weights 'acme-big' are not in"),
        (["list", "acme-smal"], 2, "did you mean 'acme-small'"),
    ],
)
def test_mistakes_are_told(capsys, arguments, code, said):
    try:
        found = main(["weights", *arguments, *PLUGIN])
    except SystemExit as stop:
        found = stop.code
    captured = capsys.readouterr()
    assert found == code and said in captured.err + captured.out


def test_a_part_without_its_weights_says_what_to_type(capsys, tmp_path):
    (tmp_path / "clip").mkdir()
    assert main(["run", str(tmp_path / "clip"), "depth=acme", *PLUGIN]) == 5
    error = capsys.readouterr().err
    assert "its weights 'acme-small' are not in" in error
    assert "droidw weights fetch acme-small" in error


def test_which_weights_are_missing_depends_on_the_options(capsys, tmp_path):
    arguments = ["run", str(tmp_path), "depth=acme", "depth.options.size=big", *PLUGIN]
    assert main(arguments) == 5
    assert "its weights 'acme-big' are not in" in capsys.readouterr().err
    torch.save({"big": torch.ones(1)}, tmp_path / "x.pth")
    assert main(["weights", "add", str(tmp_path / "x.pth"), *PLUGIN]) == 0
    capsys.readouterr()
    assert main(["run", str(tmp_path / "none"), "depth=acme", *PLUGIN]) == 5
    assert "its weights 'acme-small' are not in" in capsys.readouterr().err
    # with its weights there, the part is taken, and it is the source that is missing
    arguments[1] = str(tmp_path / "none")
    assert main([*arguments, "-o", str(tmp_path / "run")]) == 3
    assert "there is no such file or folder" in capsys.readouterr().err


def test_sizes_and_bar(capsys):
    assert [amount(n) for n in (0, 999, 88_200_000, 1_648_000_000)] == [
        "", "999 B", "88 MB", "1.6 GB",
    ]  # fmt: skip

    class Terminal:
        text = ""

        def isatty(self):
            return True

        def write(self, text):
            self.text += text

        def flush(self):
            pass

    screen = Terminal()
    bar = Bar("net", stream=screen)
    bar(0, 1000)
    bar(1000, 1000)
    bar.close()
    assert "100 %" in screen.text and "1.0 kB of 1.0 kB" in screen.text
    assert screen.text.endswith("\n")
    quiet = Terminal()
    Bar("net", quiet=True, stream=quiet)(1000, 1000)
    assert quiet.text == ""


def test_the_preset_paper_names_all_that_is_missing_at_once(capsys, tmp_path):
    assert main(["run", str(tmp_path), "--preset", "paper", "-o", str(tmp_path / "run")]) == 5
    error = capsys.readouterr().err
    line = next(li for li in error.splitlines() if "all of them: droidw weights fetch" in li)
    assert {"fit3d", "metric3d-vit-large", "droid"} <= set(line.split())
    assert not (tmp_path / "run").exists()
