"""`droidw doctor`: what it says of a healthy machine, and of one where something is missing."""

from __future__ import annotations

import argparse
import json

import pytest

from droidw.cli import doctor
from droidw.plugin.manager import load_plugins


def _main(capsys, *arguments):
    parser = argparse.ArgumentParser()
    doctor.add_arguments(parser)
    code = doctor.main(parser.parse_args(list(arguments)))
    return code, capsys.readouterr().out


@pytest.fixture
def blocked(monkeypatch):
    """The default uncertainty model is switched off."""
    monkeypatch.setenv("DROIDW_DISABLE_PLUGINS", "uncertainty/affine-softplus")


def test_healthy(capsys):
    code, out = _main(capsys)
    assert code == 0, out
    assert out.rstrip().endswith("The default preset can run here.")
    for word in ("torch", "numpy", "opencv", "cores usable", "GiB", "nvcc", "compiler", "weights"):
        assert word in out


def test_json_says_the_same(capsys):
    code, out = _main(capsys, "--json")
    report = json.loads(out)
    assert (code, report["can_run"], report["problems"]) == (0, True, [])
    assert report["plugins"]["ba"]["torch"] == "ready"
    assert report["software"]["torch"]


@pytest.mark.usefixtures("blocked")
def test_a_missing_part_is_named_and_gives_5(capsys):
    code, out = _main(capsys)
    assert code == 5
    assert "The default preset cannot run here:" in out
    assert "affine-softplus" in out


def test_a_package_that_does_not_import_is_a_problem(monkeypatch, capsys):
    monkeypatch.setitem(doctor._REQUIRED, "kornia", "kornia_that_is_not_there")
    code, out = _main(capsys)
    assert code == 5
    assert "kornia does not import" in out


def test_the_other_lietorch_is_named(monkeypatch):
    foreign = "Metadata-Version: 2.1\nName: lietorch\nSummary: PDE-G-CNN operators\n"
    real = doctor.metadata.metadata
    monkeypatch.setattr(
        doctor.metadata, "metadata", lambda name: foreign if name == "lietorch" else real(name)
    )
    assert any("lietorch" in note for note in doctor.diagnose(load_plugins()).notes)


def test_an_unwritable_cache_is_a_note(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    notes = doctor.diagnose(load_plugins()).notes
    assert any("cannot be written" in note for note in notes)


def test_nothing_is_created(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    doctor.diagnose(load_plugins())
    assert list(tmp_path.iterdir()) == []
