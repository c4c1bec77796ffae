"""`droidw run`: its arguments, and the exit codes of what is put together wrongly."""

from __future__ import annotations

import json

import pytest

from droidw import load_plugins
from droidw.cli.main import main
from droidw.cli.run import _in_full, _split
from droidw.errors import UsageError

SMALL = [
    "--preset", "cpu", "threads=1", "camera.long_side=96", "features=none", "uncertainty=none",
    "exporters.ply=null", "exporters.depth=null", "exporters.uncertainty=null",
    "observers.report=null", "observers.progress=null", "reader=synthetic",
    "reader.options={frames: 4, width: 96, height: 80}",
]  # fmt: skip

PLUGIN = """
import droidw

@droidw.hookimpl
def droidw_exporters():
    class Count:
        def export(self, result, folder):
            path = folder / "count.txt"
            path.write_text(str(len(result.trajectory)))
            return [path]
    yield droidw.Component("count", "the number of frames", lambda options, context: Count())
"""


@pytest.fixture
def run(tmp_path, capsys):
    """(exit code, standard output, standard error, run folder) of `droidw run` with arguments."""

    def call(*arguments):
        out = tmp_path / "out"
        first, rest = list(map(str, arguments[:1])), list(map(str, arguments[1:]))
        code = main(["run", *first, "-o", str(out), *SMALL, *rest])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return code, said.out, said.err, out

    return call


def test_it_runs_and_says_where_the_files_are(run):
    code, said, wrong, out = run("synthetic:static")
    assert code == 0, wrong
    assert said.startswith("4 frames, 1 keyframe, ")
    assert "scale arbitrary" in said
    assert f"{out}/trajectory.tum" in said
    assert len((out / "trajectory.tum").read_text().splitlines()) == 5


def test_quiet_says_nothing(run):
    code, said, wrong, out = run("synthetic:static", "-q", "input.max_frames=2")
    assert (code, said, wrong) == (0, "", "")
    assert (out / "trajectory.tum").exists()


def test_flags_are_other_spellings_of_keys(run):
    code, _, wrong, out = run(
        "synthetic:static", "--stride", "2", "--skip", "1", "--max-frames", "1", "--seed", "7",
        "--device", "cpu", "--focal", "90",
    )  # fmt: skip
    assert code == 0, wrong
    facts = json.loads((out / "manifest.json").read_text())
    assert (facts["frames"], facts["last_frame"], facts["seed"]) == (1, 1, 7)
    assert facts["intrinsics"]["fx"] == 90


def test_overrides_beat_flags(run):
    code, _, wrong, out = run("synthetic:static", "--max-frames", "3", "input.max_frames=2")
    assert code == 0, wrong
    assert json.loads((out / "manifest.json").read_text())["frames"] == 2


def test_a_file_beats_the_preset_and_is_beaten_by_overrides(run, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("input: {max_frames: 3}\nseed: 4\n")
    code, _, wrong, out = run("synthetic:static", "--config", file, "seed=5")
    assert code == 0, wrong
    facts = json.loads((out / "manifest.json").read_text())
    assert (facts["frames"], facts["seed"]) == (3, 5)


def test_a_file_without_a_preset_is_put_on_the_usual_one(tmp_path, monkeypatch):
    import droidw.run
    from droidw.cli.run import execute

    seen = []
    monkeypatch.setattr(droidw.run, "run", lambda resolved, *rest, **more: seen.append(resolved))
    environ = {"DROIDW_LOAD_PLUGINS": "", "DROIDW_WEIGHTS": str(tmp_path)}

    def resolved(text, *overrides):
        file = tmp_path / "mine.yaml"
        file.write_text(text)
        execute(load_plugins(environ=environ), [file], None, list(overrides), tmp_path / "out")
        return seen.pop()

    changes = resolved("input: {source: clip.mp4}\ncamera: {fov: 70}\n")
    assert (changes.preset, changes.config.camera.fov) == ("cpu", 70)
    assert changes.config.uncertainty.options["init_scale"] == 0.0
    extended = resolved("extends: presets/cpu\nseed: 3\n", "input.source=clip.mp4")
    assert (extended.preset, extended.config.seed) == (None, 3)
    assert extended.config.uncertainty == changes.config.uncertainty
    # what a run leaves means the same again
    published = resolved("uncertainty: {options: {init_scale: 1.0}}\n", "input.source=clip.mp4")
    again = resolved(published.to_yaml())
    assert again.preset is None
    assert again.config == published.config


def test_plugin_from_a_file(run, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(PLUGIN)
    code, _, wrong, out = run("synthetic:static", "--plugin", path, "exporters.count={}")
    assert code == 0, wrong
    assert (out / "count.txt").read_text() == "4"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ([], 2, ["no SOURCE is given"]),
        (["a", "b"], 2, ["'b' is neither an option nor an override"]),
        (["synthetic", "camera.long_sied=96"], 2, ["camera.long_sied", "camera.long_side"]),
        (["synthetic", "camera.long_side=wide"], 2, ["camera.long_side", "wide"]),
        (["synthetic", "input.stride=0"], 2, ["input.stride"]),
        (["synthetic", "--stride", "-1"], 2, ["input.stride"]),
        (["synthetic", "features=cn"], 5, ["'cn'", "cnn"]),
        (
            ["synthetic:nowhere", "uncertainty=affine-softplus"],
            2,
            ["'affine-softplus' needs features", "features=NAME", "uncertainty=none"],
        ),
        (["synthetic", "exporters.plyy={}"], 5, ["plyy", "ply"]),
        (["synthetic", "--preset", "cpuu"], 2, ["cpuu", "cpu"]),
        (["synthetic", "--config", "nowhere.yaml"], 2, ["nowhere.yaml"]),
        (["synthetic", "--plugin", "nowhere.py"], 2, ["nowhere.py"]),
        (["synthetic:nowhere"], 3, ["synthetic:nowhere", "synthetic:static"]),
        (["synthetic", "--skip", "9"], 3, ["input.skip"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_what_is_put_together_wrongly(run, arguments, code, words):
    got, _, wrong, out = run(*arguments)
    assert got == code, wrong
    assert wrong.startswith("droidw: error: ")
    for word in words:
        assert word in wrong
    assert not (out / "trajectory.tum").exists()


def test_no_gpu(run, monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    code, _, wrong, _ = run("synthetic", "--device", "cuda", "ba=native")
    assert code == 2 and "'native' does not run on cuda" in wrong
    code, _, wrong, _ = run("synthetic", "--device", "cuda", "correspondence=synthetic")
    assert code == 5
    assert "no GPU is visible" in wrong


def test_too_small_to_track(run):
    code, _, wrong, _ = run("synthetic:static", "camera.size=[16,16]")
    assert code == 2
    assert "camera.size: [16, 16] is not a working size" in wrong and "at least 32" in wrong


def test_source_and_overrides(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _split([]) == (None, [])
    assert _split(["clip.mp4", "a=1", "b.c=2"]) == ("clip.mp4", ["a=1", "b.c=2"])
    assert _split(["a=1", "b=2"]) == (None, ["a=1", "b=2"])
    (tmp_path / "take=2.mp4").touch()
    assert _split(["take=2.mp4", "a=1"]) == ("take=2.mp4", ["a=1"])
    with pytest.raises(UsageError, match="'b' is neither"):
        _split(["a", "b"])


def test_a_source_is_kept_by_its_whole_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clip.mp4").touch()
    assert _in_full("clip.mp4") == str(tmp_path / "clip.mp4")
    assert _in_full("bonn:balloon") == "bonn:balloon" and _in_full("gone") == "gone"


def test_without_a_folder_a_new_one_is_made(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "synthetic:static", *SMALL]) == 0
    assert main(["run", "synthetic:static", *SMALL]) == 0
    assert sorted(p.name for p in (tmp_path / "runs").iterdir()) == [
        "synthetic-static", "synthetic-static-2",
    ]  # fmt: skip
