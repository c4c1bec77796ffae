"""A named sequence as SOURCE of `droidw run`."""

from __future__ import annotations

import json

import pytest

from droidw.cli.main import main


@pytest.fixture
def balloon(trees, tmp_path):
    """Grey pictures laid out as a sequence of Bonn."""
    return trees.rgbd(tmp_path / "sets" / "Bonn" / "rgbd_bonn_balloon", count=10, size=(160, 120))


def test_a_named_sequence_is_run_and_scored(balloon, tmp_path, capsys):
    out = tmp_path / "run"
    code = main(
        ["run", "bonn:balloon", "--data", str(tmp_path / "sets"), "-o", str(out), "--preset", "cpu",
         "-q", "camera.long_side=96", "backend.passes=[]", "--max-frames", "6"]
    )  # fmt: skip
    facts = json.loads((out / "manifest.json").read_text())
    # plain grey pictures: nothing to match, which is told, and all else is in order
    assert code == 4 and "nothing could be matched" in capsys.readouterr().err
    assert facts["source"] == "bonn:balloon" and facts["frames"] == 6
    assert "from bonn-balloon" in facts["camera"]
    assert facts["intrinsics"]["fx"] == pytest.approx(542.822841 * 96 / 640, rel=1e-3)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("bonn:baloon", "did you mean 'bonn:balloon'"),
        ("bon:balloon", "no dataset is called 'bon'"),
        ("bon:balloon", "did you mean 'bonn:balloon'"),
        ("syntetic:room", "did you mean 'synthetic:room'"),
        ("bonn:crowd", "droidw data fetch bonn:crowd"),
        ("dycheck:apple", "by hand from https://drive.google.com"),
    ],
)
def test_what_is_not_there_is_told(source, said, balloon, tmp_path, capsys):
    arguments = ["--data", str(tmp_path / "sets"), "--preset", "cpu", "-o", str(tmp_path / "run")]
    assert main(["run", source, *arguments]) == 3
    assert said in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
