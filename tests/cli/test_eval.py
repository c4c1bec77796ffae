"""`droidw eval` end to end on files."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from droidw.cli import evaluate
from droidw.errors import DroidwError, InputError, UsageError


def circle(count: int, scale: float = 1.0, noise: float = 0.0) -> np.ndarray:
    """Rows t tx ty tz qx qy qz qw of a camera that goes round."""
    s = np.linspace(0, 2 * np.pi, count)
    rows = np.zeros((count, 8))
    rows[:, 0] = np.arange(count) / 30.0
    rows[:, 1], rows[:, 2], rows[:, 3] = np.cos(s), np.sin(s), 0.1 * s
    rows[:, 1:4] = scale * rows[:, 1:4] + np.random.default_rng(0).normal(0, noise, (count, 3))
    rows[:, 7] = 1.0
    return rows


@pytest.fixture
def places(tmp_path: Path) -> tuple[Path, Path]:
    """A run folder and the source it was made from, with masks and uncertainty maps."""
    source, run = tmp_path / "source", tmp_path / "run"
    for folder in (source / "rgb", source / "mask", run / "uncertainty"):
        folder.mkdir(parents=True)
    np.savetxt(source / "groundtruth.txt", circle(60), header="t tx ty tz qx qy qz qw")
    np.savetxt(run / "trajectory.tum", circle(60, 0.5, 0.005))
    np.savetxt(run / "keyframes.tum", circle(60, 0.5, 0.005)[::6])
    (run / "manifest.json").write_text(json.dumps({"source": str(source)}))
    for i in range(2):
        mask = np.zeros((48, 64), np.uint8)
        mask[:, :24] = 255
        cv2.imwrite(str(source / "mask" / f"{i:06d}.png"), mask)
        u = np.full((6, 8), 900, np.uint16)
        u[:, :3] = 30000
        cv2.imwrite(str(run / "uncertainty" / f"{i:06d}.png"), u)
    return run, source


def run_eval(*words: object) -> int:
    """The verb as the command line calls it."""
    parser = argparse.ArgumentParser()
    evaluate.add_arguments(parser)
    return evaluate.main(parser.parse_args([str(word) for word in words]))


def test_json_of_a_run_folder(places: tuple[Path, Path], capsys: pytest.CaptureFixture) -> None:
    run, source = places
    assert run_eval(run, "--ref", source / "groundtruth.txt", "--json") == 0
    told = capsys.readouterr()
    record = json.loads(told.out, parse_constant=lambda name: pytest.fail(name))
    for key in ("ate_rmse", "ate_median", "scale", "path_length"):
        assert isinstance(record[key], float)
    assert (record["matched"], record["frames"]) == (60, 60)
    assert record["scale"] == pytest.approx(2.0, rel=0.02)
    assert 0.005 < record["ate_rmse"] < 0.03
    assert record["align"] == "sim3" and record["unit"] == "m"
    assert record["estimate"].endswith("trajectory.tum")
    assert record["keyframes"]["matched"] == 10
    assert record["masks"]["auc"] == 1.0 and record["masks"]["frames"] == 2
    assert not (run / "metrics.json").exists()


def test_table_of_a_run_folder(places: tuple[Path, Path], capsys: pytest.CaptureFixture) -> None:
    run, _ = places
    assert run_eval(run, "--delta", "0.5s") == 0
    out = capsys.readouterr().out
    for said in ("all frames", "keyframes", "60 / 60", "10 / 10", "ATE rmse [m]", "scale applied",
                 "alignment sim3", "RPE over 0.5 s", "AUC 1.000"):  # fmt: skip
        assert said in out, said
    assert "60 of 60 stamps matched with 60 of the reference; largest difference 0.0 ms" in out


def test_normalised(places: tuple[Path, Path], capsys: pytest.CaptureFixture) -> None:
    run, _ = places
    assert run_eval(run, "--json") == 0
    plain = json.loads(capsys.readouterr().out)
    assert run_eval(run, "--normalise", "displacement", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    # The circle rises by 0.2 pi.
    gap = 0.2 * np.pi
    assert record["ate_rmse"] == pytest.approx(plain["ate_rmse"] / gap)
    assert record["keyframes"]["ate_rmse"] == pytest.approx(plain["keyframes"]["ate_rmse"] / gap)
    assert (record["normalise"], plain["normalise"]) == ("displacement", "none")
    run_eval(run, "--normalise", "path")
    out = capsys.readouterr().out
    assert "ATE rmse [path]" in out and "all lengths are divided by the reference's path" in out


def test_plots(places: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run, _ = places
    before = set(run.rglob("*"))
    assert run_eval(run, "--plot", tmp_path / "new" / "plots", "--json") == 0
    told = capsys.readouterr()
    json.loads(told.out)
    names = ["ate.svg", "rpe.svg", "trajectory.svg"]
    assert sorted(p.name for p in (tmp_path / "new" / "plots").iterdir()) == names
    assert all(name in told.err for name in names)
    assert set(run.rglob("*")) == before


def test_save_writes_into_the_run_folder(
    places: tuple[Path, Path], capsys: pytest.CaptureFixture
) -> None:
    run, source = places
    assert run_eval(run, "--ref", source, "--json", "--save") == 0
    assert json.loads((run / "metrics.json").read_text()) == json.loads(capsys.readouterr().out)
    with pytest.raises(UsageError, match="--save writes into a run folder"):
        run_eval(run / "trajectory.tum", "--ref", source, "--save")


def test_alignments_differ(places: tuple[Path, Path], capsys: pytest.CaptureFixture) -> None:
    run, source = places
    errors = {}
    for align in ("sim3", "se3", "scale", "none"):
        run_eval(run / "trajectory.tum", "--ref", source, "--align", align, "--json")
        record = json.loads(capsys.readouterr().out)
        errors[align] = record["ate_rmse"]
        assert (record["scale"] == 1.0) == (align in ("se3", "none"))
    assert errors["sim3"] <= min(errors.values()) and errors["se3"] <= errors["none"]


def test_source_from_the_config(places: tuple[Path, Path], capsys: pytest.CaptureFixture) -> None:
    run, source = places
    (run / "manifest.json").unlink()
    (run / "config.yaml").write_text(f"input:\n  source: tum:{source}\n")
    assert run_eval(run, "--json") == 0
    assert json.loads(capsys.readouterr().out)["masks"]["frames"] == 2


def test_bad_rows_are_left_out_and_told(
    places: tuple[Path, Path], capsys: pytest.CaptureFixture
) -> None:
    run, source = places
    truth = source / "groundtruth.txt"
    lines = truth.read_text().splitlines()
    lines[5] = "0.1333 nan 0 0 0 0 0 1"
    truth.write_text("\n".join(lines) + "\n")
    assert run_eval(run, "--ref", truth, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["ref_skipped"] == 1 and record["matched"] == 59
    assert any("groundtruth.txt, line 6" in note for note in record["notes"])


def test_a_run_that_was_told_what_moves(
    places: tuple[Path, Path], capsys: pytest.CaptureFixture
) -> None:
    run, source = places
    for masks, told in (("", False), (str(source / "mask"), True)):
        (run / "config.yaml").write_text(f"input: {{source: '{source}', masks: '{masks}'}}\n")
        assert run_eval(run, "--ref", source / "groundtruth.txt", "--json") == 0
        notes = json.loads(capsys.readouterr().out)["notes"]
        assert any("the run was told what moves" in note for note in notes) == told


def test_a_folder_called_as_a_sequence_is_not_the_source(
    places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from droidw.eval.summary import source_of

    run, source = places
    monkeypatch.chdir(source.parent)
    for text, known in ((f"bonn:{source.name}", None), (f"tum:{source}", source)):
        (run / "config.yaml").write_text(f"input: {{source: '{text}'}}\n")
        (run / "manifest.json").unlink(missing_ok=True)
        assert source_of(run) == known


def test_masks_that_a_run_found_are_no_truth(
    places: tuple[Path, Path], capsys: pytest.CaptureFixture
) -> None:
    run, source = places
    for own in (False, True):
        if own:
            (source / "mask" / "scale.json").write_text(json.dumps({"named": "index"}))
        given = ("--ref", source / "groundtruth.txt", "--masks", source / "mask", "--json")
        assert run_eval(run, *given) == 0
        notes = json.loads(capsys.readouterr().out)["notes"]
        assert any("are what a run found" in note for note in notes) == own


@pytest.mark.parametrize("named", [True, False], ids=["--masks", "mask/ of the source"])
def test_masks_alone(places: tuple[Path, Path], named: bool, capsys: pytest.CaptureFixture) -> None:
    run, source = places
    (source / "groundtruth.txt").unlink()
    given = ["--masks", source / "mask"] if named else []
    assert run_eval(run, *given, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert set(record) == {"masks", "notes"}
    assert record["masks"]["auc"] == 1.0 and record["masks"]["frames"] == 2
    assert any("only masks are scored" in note for note in record["notes"])
    assert run_eval(run, *given, "--save") == 0
    assert "AUC 1.000" in capsys.readouterr().out
    assert json.loads((run / "metrics.json").read_text()) == record
    assert "no true poses are known" in str(refusal(run, *given, "--plot", run / "plots"))


def refusal(*words: object) -> DroidwError:
    with pytest.raises(DroidwError) as caught:
        run_eval(*words)
    return caught.value


def test_what_is_wrong_is_said(places: tuple[Path, Path], tmp_path: Path) -> None:
    run, source = places
    truth = source / "groundtruth.txt"
    cases = [
        ((tmp_path / "nothing", "--ref", truth), 3, "there is no such file"),
        ((tmp_path, "--ref", truth), 3, "trajectory.tum"),
        ((run, "--ref", tmp_path / "no.txt"), 3, "no such reference file"),
        ((run, "--ref", tmp_path), 3, "holds no groundtruth.txt"),
        ((run, "--ref", source / "mask" / "000000.png"), 3, "not a text file"),
        ((run, "--ref", run / "manifest.json"), 3, "line 1"),
        ((run / "trajectory.tum",), 2, "nothing to compare with"),
        ((run, "--ref", truth, "--t-max-diff", "-1"), 2, "time difference"),
        ((run, "--ref", truth, "--delta", "0"), 2, "--delta"),
        ((run / "trajectory.tum", "--ref", truth, "--masks", source / "mask"), 2, "--masks"),
        ((run, "--ref", truth, "--masks", tmp_path / "no"), 3, "no such folder"),
        (
            (run, "--ref", truth, "--masks", source / "mask", "--masks-after", "2"),
            3,
            "none is left after the first 2",
        ),
        ((run, "--ref", truth, "--masks-after", "-1"), 2, "--masks-after counts keyframes from 0"),
        ((run, "--ref", truth, "--plot", truth), 2, "--plot: cannot make the folder"),
    ]
    for words, code, said in cases:
        error = refusal(*words)
        assert error.exit_code == code, words
        assert said in str(error), str(error)


@pytest.mark.parametrize("size", [(64, 64), (48, 64), (96, 48)], ids=str)
def test_masks_of_another_shape(
    places: tuple[Path, Path], size: tuple[int, int], capsys: pytest.CaptureFixture
) -> None:
    """Refused where they were asked for; where they lie beside the footage, the poses count."""
    run, source = places
    (run / "uncertainty" / "scale.json").write_text(json.dumps({"picture": [64, 48]}))
    for path in (source / "mask").iterdir():
        cv2.imwrite(str(path), np.zeros((size[1], size[0]), np.uint8))
    error = refusal(run, "--masks", source / "mask")
    assert error.exit_code == 3
    assert f"{source / 'mask' / '000000.png'}: a mask of {size[0]}x{size[1]} pixels" in str(error)
    assert "does not fit pictures of 64x48" in str(error) and "--masks DIR" in error.hint
    assert run_eval(run, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert "masks" not in record and record["ate_rmse"] < 0.03
    assert any("masks are not scored: " in note for note in record["notes"])


@pytest.mark.parametrize("size", [(640, 480), (32, 24), (8, 6)], ids=str)
def test_masks_of_another_size(
    places: tuple[Path, Path], size: tuple[int, int], capsys: pytest.CaptureFixture
) -> None:
    run, source = places
    for path in (source / "mask").iterdir():
        mask = np.zeros((size[1], size[0]), np.uint8)
        mask[:, : size[0] * 3 // 8] = 255
        cv2.imwrite(str(path), mask)
    assert run_eval(run, "--masks", source / "mask", "--json") == 0
    assert json.loads(capsys.readouterr().out)["masks"]["auc"] == 1.0


def test_fewer_masks_than_maps(places: tuple[Path, Path], capsys: pytest.CaptureFixture) -> None:
    run, source = places
    (source / "rgb.txt").write_text("0.0 rgb/000000.png\n0.1 rgb/000001.png\n")
    (source / "mask" / "000000.png").unlink()
    assert run_eval(run, "--masks", source / "mask") == 0
    assert "note: 1 of 2 uncertainty maps have a mask" in capsys.readouterr().out
    (source / "mask" / "000001.png").rename(source / "mask" / "other.png")
    error = refusal(run, "--masks", source / "mask")
    assert error.exit_code == 3
    assert "its 1 masks cannot be laid on 2 pictures" in str(error)
    assert "name each mask like its picture" in error.hint


def test_truth_of_another_time(places: tuple[Path, Path]) -> None:
    run, source = places
    truth = circle(60)
    truth[:, 0] += 500.0
    np.savetxt(source / "groundtruth.txt", truth)
    error = refusal(run)
    assert error.exit_code == 3
    assert "0 pairs within 0.02 s, at least" in str(error)
    assert "they lie 498.033 s apart" in str(error) and "--t-offset 500.0" in error.hint


def test_frame_indices_for_stamps(places: tuple[Path, Path]) -> None:
    run, source = places
    rows = circle(60, 0.5)
    rows[:, 0] = np.arange(60)
    np.savetxt(run / "trajectory.tum", rows)
    truth = circle(60)
    truth[:, 0] += 1311868163.0
    np.savetxt(source / "groundtruth.txt", truth, fmt="%.9f")
    error = refusal(run)
    assert isinstance(error, InputError)
    assert "est 60 stamps 0-59 s: these look like frame indices" in error.message


def test_few_keyframes_do_not_spoil_the_rest(
    places: tuple[Path, Path], capsys: pytest.CaptureFixture
) -> None:
    run, _ = places
    np.savetxt(run / "keyframes.tum", circle(60, 0.5)[:2])
    assert run_eval(run, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert "keyframes" not in record
    assert any("keyframes are not scored" in note for note in record["notes"])
