"""Output folders that cannot be used, parts that fail, and what a run leaves all the same."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from droidw.errors import UsageError
from droidw.run.folder import prepare

RAISING = """
import droidw

class Deaf:
    def on_event(self, event):
        raise RuntimeError(f"cannot hear {type(event).__name__}")

class Clumsy:
    def export(self, result, folder):
        (folder / "half.txt").write_text("half")
        raise ValueError("the printer is on fire")

@droidw.hookimpl
def droidw_observers():
    yield droidw.Component("deaf", "raises", lambda options, context: Deaf())

@droidw.hookimpl
def droidw_exporters():
    yield droidw.Component("aa-clumsy", "raises", lambda options, context: Clumsy())
"""


@pytest.fixture
def plugin(tmp_path):
    """A plugin in one file."""

    def write(text):
        path = tmp_path / "mine.py"
        path.write_text(text)
        return path

    return write


def test_what_a_run_leaves(go, footage):
    ran = go(footage(count=12).folder, "observers.report={}")
    assert ran.code == 0, ran.err
    held = {path.name for path in ran.folder.iterdir()}
    assert {"trajectory.tum", "keyframes.tum", "points.ply", "report.html", "config.yaml",
            "manifest.json", "log.txt"} <= held  # fmt: skip
    assert set(ran.manifest["files"]) == held
    for name in held:
        assert name in ran.out


def test_the_manifest_is_put_together_once(go, footage, monkeypatch):
    from droidw.run import drive

    described, calls = drive.facts_of_setup, []
    monkeypatch.setattr(
        drive, "facts_of_setup", lambda *given: calls.append(given) or described(*given)
    )
    ran = go(footage(count=3).folder)
    assert ran.code == 0, ran.err
    assert len(calls) == 1
    # what only the end of a run knows is in it all the same
    assert "export" in ran.manifest["stages"] and "points.ply" in ran.manifest["files"]


def test_files_that_are_not_there_are_not_announced(go, footage):
    ran = go(footage(count=3).folder, "exporters.ply=null")
    held = {path.name for path in ran.folder.iterdir()}
    assert set(ran.manifest["files"]) == held
    assert "report.html" not in ran.out and "points.ply" not in ran.out


def test_a_file_in_the_way(go, footage, tmp_path):
    (tmp_path / "out").write_text("precious")
    ran = go(footage(count=3).folder)
    assert ran.code == 2
    assert "a file of that name is in the way" in ran.err
    assert (tmp_path / "out").read_text() == "precious"


def test_a_file_in_place_of_a_parent(go, footage, tmp_path):
    (tmp_path / "out").write_text("precious")
    ran = go(footage(count=3).folder, to="out/deeper")
    assert ran.code == 2
    assert "in the way" in ran.err


def test_a_folder_that_may_not_be_written(go, footage, monkeypatch):
    allowed = os.access

    def access(path, mode, **more):
        return Path(path).name != "out" and allowed(path, mode, **more)

    monkeypatch.setattr(os, "access", access)
    ran = go(footage(count=3).folder)
    assert ran.code == 2
    assert "cannot be written to" in ran.err


def test_a_filled_folder_needs_overwrite(go, footage):
    clip = footage(count=8)
    first = go(clip.folder)
    kept = (first.folder / "trajectory.tum").read_bytes()
    (first.folder / "notes.txt").write_text("mine")
    again = go(clip.folder, "--max-frames", "3")
    assert again.code == 2
    assert "is not empty" in again.err and "--overwrite" in again.err
    assert (first.folder / "trajectory.tum").read_bytes() == kept
    third = go(clip.folder, "--max-frames", "3", "--overwrite")
    assert third.code == 0, third.err
    assert len(third.poses) == 3
    assert (first.folder / "notes.txt").read_text() == "mine"


def contents(folder):
    """Every file in a folder and below, with what is in it."""
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_refused_run_leaves_the_earlier_one_as_it_was(go, footage, tmp_path):
    clip = footage(count=6)
    first = go(clip.folder, "exporters.depth.full=true")
    (first.folder / "depth" / "mine").mkdir()
    (first.folder / "depth" / "mine" / "notes.txt").write_text("mine")
    kept = contents(first.folder)
    for wrong in (
        (tmp_path / "mistyped",),
        (clip.folder, "camera.calib=nowhere.txt"),
        (clip.folder, "--masks", tmp_path / "nowhere"),
    ):
        again = go(*wrong, "--overwrite")
        assert again.code == 3
        assert contents(first.folder) == kept
    done = go(clip.folder, "--max-frames", "3", "--overwrite")
    assert done.code == 0, done.err
    files = contents(first.folder)
    assert len(done.poses) == 3 and len(files) < len(kept)
    assert not [path for path in files if path.name.startswith(".") or "full" in path.parts]
    assert files[Path("depth/mine/notes.txt")] == b"mine"


def test_what_a_run_reads_is_never_replaced(go, footage):
    clip = footage(count=6)
    first = go(clip.folder)
    kept = contents(first.folder)
    for key in ("input.masks", "camera.calib"):
        again = go(clip.folder, f"{key}={first.folder / 'trajectory.tum'}", "--overwrite")
        assert again.code == 2
        assert f"{key}: {first.folder / 'trajectory.tum'} lies in the output folder" in again.err
        assert contents(first.folder) == kept


def test_until_it_has_something_to_keep_a_run_replaces_nothing(tmp_path):
    """Killed before that, it leaves an earlier run whole; afterwards nothing of that is left."""
    earlier = {Path("trajectory.tum"): b"poses", Path("config.yaml"): b"of the first"}
    earlier |= {Path("depth/full/000000.png"): b"deep", Path("masks/000000.png"): b"dark"}
    for path, data in earlier.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(data)
    folder = prepare(tmp_path, overwrite=True)
    folder.early("config.yaml").write_text("of the second")
    found = contents(tmp_path)
    assert {path: found[path] for path in earlier} == earlier
    folder.finish()
    assert contents(tmp_path) == earlier
    folder = prepare(tmp_path, overwrite=True)
    folder.early("config.yaml").write_text("of the third")
    folder.begin()
    (tmp_path / "trajectory.tum").write_text("other poses")
    folder.finish()
    left = {Path("config.yaml"): b"of the third", Path("trajectory.tum"): b"other poses"}
    assert contents(tmp_path) == left
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.yaml", "trajectory.tum"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no file locks")
@pytest.mark.parametrize("overwrite", [False, True])
def test_two_runs_do_not_write_into_one_folder(tmp_path, overwrite):
    first = prepare(tmp_path / "out", overwrite=False)
    if overwrite:
        first.early("config.yaml").write_text("of the first")
    with pytest.raises(UsageError, match="another run is writing into this") as error:
        prepare(tmp_path / "out", overwrite)
    assert "-o FOLDER" in error.value.hint
    if overwrite:
        assert first.early("config.yaml").read_text() == "of the first"
    first.finish()
    second = prepare(tmp_path / "out", overwrite)
    assert not second.replaces  # the first one left nothing
    second.finish()


def test_overwrite_spares_what_is_no_run(go, footage, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    ran = go(footage(count=3).folder, "--overwrite")
    assert ran.code == 2
    assert "this is none" in ran.err
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["thesis.tex"]


def test_the_footage_is_never_the_output(go, footage):
    clip = footage(count=3)
    before = sorted(p.name for p in clip.folder.iterdir())
    ran = go(clip.folder, "--overwrite", to="clip")
    assert ran.code == 2
    assert sorted(p.name for p in clip.folder.iterdir()) == before


def test_parts_that_raise_lose_nothing(go, footage, plugin):
    clip = footage()
    ran = go(
        clip.folder, "--plugin", plugin(RAISING),
        "observers.deaf={}", "exporters.aa-clumsy={}", "observers.report={}",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    assert len(ran.poses) == len(clip.times)
    assert {"keyframes.tum", "points.ply", "report.html"} <= {p.name for p in ran.folder.iterdir()}
    assert "observer 'deaf' raised RuntimeError: cannot hear RunStarted" in ran.warnings
    assert ran.err.count("cannot hear") == 1
    assert "exporter 'aa-clumsy' failed" in ran.warnings
    assert "the printer is on fire" in ran.warnings


BREAKS = """
import droidw

class Bomb:
    dim = 0
    def __init__(self):
        self.left = 3
    def extract(self, image, grid):
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("out of ideas")
        return image.new_zeros(0, grid.height, grid.width)

@droidw.hookimpl
def droidw_feature_extractors():
    yield droidw.Component("bomb", "raises at the fourth keyframe", lambda o, c: Bomb())
"""


def test_a_part_that_breaks_while_tracking_keeps_what_was_tracked(go, footage, plugin):
    ran = go(footage().folder, "--plugin", plugin(BREAKS), "features=bomb")
    assert ran.code == 1
    assert "out of ideas" in ran.err
    assert "tracking stopped after" in ran.warnings
    assert 5 < len(ran.poses) < 26
    assert len(ran.poses) == ran.manifest["frames"]


BROKEN_READERS = """
import droidw

class Nosy:
    def recognises(self, source):
        return open(source + "/acme.json").read() != ""

def burnt(options, context):
    raise RuntimeError("the lens is cracked")

@droidw.hookimpl
def droidw_dataset_readers():
    yield droidw.Component("aa-nosy", "raises where it looks", lambda o, c: Nosy())
    yield droidw.Component("aa-burnt", "cannot be made", burnt)

@droidw.hookimpl
def droidw_observers():
    yield droidw.Component("unborn", "cannot be made", burnt)
"""


def test_readers_that_nobody_chose_and_observers_cost_nothing(go, footage, plugin, tmp_path):
    path = plugin(BROKEN_READERS)
    ran = go(footage(count=14).folder, "--plugin", path, "observers.unborn={}")
    assert ran.code == 0, ran.err
    assert len(ran.poses) == 14
    assert "observer 'unborn' failed: RuntimeError: the lens is cracked" in ran.warnings
    log = (ran.folder / "log.txt").read_text()
    assert "reader 'aa-nosy' was left out" in log and "the lens is cracked" in log
    notes = tmp_path / "notes.txt"
    notes.write_text("words")
    refused = go(notes, "--plugin", path, to="refused")
    assert refused.code == 3 and "left out: 'aa-burnt' (" in refused.err


NONSENSE = """
import droidw
from droidw.interfaces.uncertainty import UncertaintyReport

class Odd:
    fields = ()
    def append(self, view, index):
        view.uncertainty[index] = 0.0
        view.uncertainty[index, 0, 0] = {value}
    def update(self, view):
        return UncertaintyReport()

@droidw.hookimpl
def droidw_uncertainty_models():
    yield droidw.Component("odd", "one cell in each keyframe is no uncertainty", lambda o, c: Odd())
"""


@pytest.mark.parametrize("value", ["float('nan')", "float('inf')", "-3.0"])
def test_uncertainty_that_is_none_is_told_of(go, footage, plugin, value):
    ran = go(footage().folder, "--plugin", plugin(NONSENSE.format(value=value)), "uncertainty=odd")
    assert ran.code == 0, ran.err
    assert len(ran.poses) == 26
    count = ran.manifest["keyframes"]
    told = f"{count} cells were left an uncertainty that is negative"
    assert told in ran.warnings and told in ran.err


def test_a_refused_input_leaves_no_folder_in_the_way(tmp_path):
    from droidw.cli.main import main

    out = tmp_path / "out"
    for _ in range(2):
        assert main(["run", str(tmp_path / "nowhere.mp4"), "-o", str(out)]) == 3
        assert not out.exists()


NO_REPORT = NONSENSE.format(value="1.0").replace("return UncertaintyReport()", "pass")
NO_FIELDS = NONSENSE.format(value="1.0").replace("fields =", "fieldz =")


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (NO_REPORT, "`update` returned NoneType, no UncertaintyReport"),
        (
            NO_FIELDS,
            "uncertainty model 'odd' breaks its contract: what its factory makes, a Odd, has",
        ),
    ],
    ids=["no report", "no fields"],
)
def test_a_part_that_breaks_its_contract_is_named(go, footage, plugin, code, said):
    ran = go(footage(count=14).folder, "--plugin", plugin(code), "uncertainty=odd")
    assert ran.code == 5
    assert said in ran.err and "bug of droidw" not in ran.err


FAULTY = """

import droidw
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

class Faulty(TorchBundleAdjuster):
    left = 3
    def step(self, problem):
        step = super().step(problem)
        if not problem.motion_only:
            self.left -= 1
            if self.left == 0:
                step.disps[0, 2, 3] = float("nan")
        return step

@droidw.hookimpl
def droidw_ba_backends():
    yield droidw.Component("faulty", "one step that is not finite", lambda o, c: Faulty())
"""


def test_a_step_that_is_not_finite_costs_that_step_alone(go, footage, plugin):
    """What is no number would end the process in a search that sets out from it."""
    ran = go(footage(count=14).folder, "--plugin", plugin(FAULTY), "ba=faulty")
    assert ran.code == 0, ran.err
    assert len(ran.poses) == 14
    assert "1 bundle adjustment steps were not finite and were left out" in ran.warnings


SHAPES = """
import numpy as np, torch, droidw
from droidw.interfaces.depth import DepthMap

class Mine:
    dim = 4
    metric = True
    def extract(self, image, grid):
        return {features}
    def predict(self, frame):
        h, w = frame.image.shape[1:]
        return {depth}

READY = frozenset({{"cpu", "features", "depth"}})

@droidw.hookimpl
def droidw_feature_extractors():
    yield droidw.Component("mine", "of a stranger", lambda o, c: Mine(), capabilities=READY)

@droidw.hookimpl
def droidw_depth_priors():
    yield droidw.Component("mine", "of a stranger", lambda o, c: Mine(), capabilities=READY)
"""


@pytest.mark.parametrize(
    ("slot", "features", "depth", "said"),
    [
        (
            "features",
            "torch.zeros(4, 3, 3)",
            "None",
            "`extract` returned a tensor [4, 3, 3], not a",
        ),
        ("features", "torch.zeros(5, grid.height, grid.width)", "None", "tensor [5, 15, 20], not"),
        (
            "features",
            "np.zeros((4, grid.height, grid.width))",
            "None",
            "returned ndarray [4, 15, 20]",
        ),
        (
            "depth",
            "None",
            "torch.ones(h, w)",
            "`predict` returned a tensor [120, 160], not a DepthMap",
        ),
        ("depth", "None", "DepthMap(torch.ones(3, w))", "returned a DepthMap of a tensor [3, 160]"),
    ],
)
def test_maps_of_the_wrong_shape_are_told(go, footage, plugin, slot, features, depth, said):
    file = plugin(SHAPES.format(features=features, depth=depth))
    ran = go(footage(count=8).folder, "--plugin", file, f"{slot}=mine")
    assert ran.code == 5, ran.err
    assert said in ran.err and "bug of droidw" not in ran.err


@pytest.mark.parametrize("depth", ["None", "DepthMap(torch.full((h, w), float('nan')))"])
def test_a_prior_that_gives_no_depth_makes_nothing_metric(go, footage, plugin, depth):
    file = plugin(SHAPES.format(features="None", depth=depth))
    ran = go(footage(count=14).folder, "--plugin", file, "depth=mine")
    assert ran.code == 0, ran.err
    assert ran.manifest["scale"] == "arbitrary"


EXITS = RAISING.replace("raise RuntimeError(", "raise SystemExit(").replace(
    "raise ValueError", "raise SystemExit"
)


def test_parts_that_leave_end_no_run(go, footage, plugin):
    more = ("observers.deaf={}", "exporters.aa-clumsy={}")
    ran = go(footage(count=8).folder, "--plugin", plugin(EXITS), *more)
    assert ran.code == 0, ran.err
    assert len(ran.poses) == 8 and ran.manifest["frames"] == 8
    assert "observer 'deaf' raised SystemExit" in ran.warnings
    assert "exporter 'aa-clumsy' failed: SystemExit" in ran.warnings
