"""Every built-in part passes the suite of its kind, as any third-party part must."""

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

import droidw
from droidw.testing.conformance import check
from droidw.testing.scenes import Scene, SceneSpec

ENTRIES = [e for e in droidw.load_plugins().entries() if e.distribution == "droidw"]
PARTS = [pytest.param(e, id=f"{e.kind}-{e.component.name}") for e in ENTRIES if e.kind != "reader"]
READERS = {e.component.name: e.component for e in ENTRIES if e.kind == "reader"}


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    """The same eight pictures as a folder, as a TUM sequence, and as a video."""
    root = tmp_path_factory.mktemp("footage")
    scene = Scene(SceneSpec(width=96, height=72, frames=8, fps=10))
    scene.write(root / "clip")
    tum = root / "rgbd_dataset_freiburg3_made_up"
    scene.write(tum)
    (tum / "camera.txt").unlink()
    (tum / "accelerometer.txt").write_text("# timestamp ax ay az\n")
    listing = (tum / "rgb.txt").read_text().replace("# timestamp", "# color images\n# timestamp")
    (tum / "rgb.txt").write_text(listing)
    (tum / "depth.txt").write_text(listing.replace("rgb/", "depth/"))
    writer = cv2.VideoWriter(str(root / "clip.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (96, 72))
    for index in range(len(scene)):
        writer.write(np.ascontiguousarray(scene.render(index).image[..., ::-1]))
    writer.release()
    trees = _trees()
    trees.rgbd(root / "rgbd_bonn_made_up", count=8)
    return {
        "bonn": str(root / "rgbd_bonn_made_up"),
        "droidw": str(trees.walk(root / "downtown", count=8)),
        "dycheck": str(trees.dycheck(root / "scene", numbers=range(8))),
        "euroc": str(trees.euroc(root / "MH_00", count=8)),
        "kitti": str(trees.kitti(root / "kitti", count=8)),
        "folder": str(root / "clip"),
        "tum": str(tum),
        "video": str(root / "clip.avi"),
        "synthetic": "synthetic:orbit",
    }


def _trees():
    """The maker of small datasets; test folders are not packages."""
    path = Path(__file__).parents[1] / "datasets" / "trees.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def skip_unless_ready(entry):
    status = droidw.load_plugins().registry(entry.kind).status(entry.component.name)
    if status != "ready":
        pytest.skip(f"{entry.kind} {entry.component.name} cannot run here: {status}")


@pytest.mark.parametrize("entry", PARTS)
def test_part_keeps_the_contract_of_its_kind(entry, device, tmp_path):
    skip_unless_ready(entry)
    if device.type not in entry.component.capabilities:
        pytest.skip(f"{entry.component.name} does not run on {device.type}")
    options = None
    if (entry.kind, entry.component.name) == ("depth", "file"):
        Scene(SceneSpec(width=96, height=72, frames=1)).write(tmp_path)
        options = entry.component.options(path=str(tmp_path / "depth"))
    check(entry.kind, entry.component, device, options)


def test_a_model_that_begins_with_what_can_move_keeps_the_contract(device):
    [entry] = [e for e in ENTRIES if e.component.name == "affine-softplus"]
    options = entry.component.options(
        movable_gain=8.0, movable_keep=0.9, learn_majority=0.6, smooth=1
    )
    check("uncertainty", entry.component, device, options)


@pytest.mark.parametrize("name", READERS)
def test_reader_keeps_the_contract(name, footage):
    component = READERS[name]
    assert name in footage, f"no footage for reader '{name}' in this test: add some"
    options = component.options(frames=8, width=96, height=72) if name == "synthetic" else None
    check("reader", component, options=options, source=footage[name])


def test_all_kinds_have_built_ins():
    kinds = {e.kind for e in ENTRIES}
    assert kinds == {
        "features",
        "depth",
        "uncertainty",
        "ba",
        "correspondence",
        "reader",
        "exporter",
        "observer",
    }
