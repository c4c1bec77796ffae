"""Exporter `depth`: pictures and numbers read back."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from droidw.errors import UsageError
from droidw.geometry.camera import Grid
from droidw.interfaces.exporters import Exporter
from droidw.slam.frame import Frame
from droidw.testing._check_files import sample_result
from droidw.testing.conformance import check_exporter
from droidw_plugins.depth._folder import FileDepth
from droidw_plugins.depth.file import FileDepthOptions
from droidw_plugins.exporters import depth


@pytest.fixture
def result():
    """Three keyframes of a synthetic scene, one cell without depth and some unconfirmed."""
    full = sample_result()
    records = []
    for keyframe in full.keyframes:
        disp, valid = keyframe.disp.copy(), keyframe.depth_valid.copy()
        disp[0, :4] = [0, -1, np.nan, np.inf]
        valid[0, :5] = True
        valid[5, 6:] = False
        records.append(replace(keyframe, disp=disp, depth_valid=valid))
    return replace(full, keyframes=tuple(records))


def truth(keyframe):
    known = np.isfinite(keyframe.disp) & (keyframe.disp > 0)
    return np.where(known, 1 / np.where(known, keyframe.disp, 1), 0), known


def picture(folder, keyframe):
    read = cv2.imread(str(folder / f"{keyframe.index:06d}.png"), cv2.IMREAD_UNCHANGED)
    assert read.dtype == np.uint16
    return read.astype(np.float64)


def test_conformance():
    check_exporter(depth.COMPONENT)


@pytest.mark.parametrize("everything", [False, True])
def test_pictures(result, tmp_path, everything):
    exporter = depth.COMPONENT.factory(depth.DepthOptions(all=everything), None)
    assert isinstance(exporter, Exporter)
    written = exporter.export(result, tmp_path)
    folder = tmp_path / "depth"
    names = ["000000.png", "000002.png", "000004.png", "depth.npz", "scale.json"]
    assert sorted(path.name for path in folder.iterdir()) == names
    assert sorted(written) == [folder / name for name in names]
    facts = json.loads((folder / "scale.json").read_text())
    assert 1000 <= facts["median_depth"] / facts["scale"] < 10000
    assert facts["cells_too_far"] == 0
    for keyframe in result.keyframes:
        exact, known = truth(keyframe)
        shown = known if everything else known & keyframe.depth_valid
        assert 0 < shown.sum() < shown.size
        read = picture(folder, keyframe)
        np.testing.assert_array_equal(read > 0, shown)
        np.testing.assert_allclose(
            (read * facts["scale"])[shown], exact[shown], atol=0.501 * facts["scale"]
        )


@pytest.mark.parametrize("metric", [False, True])
def test_depth_prior_file_takes_what_was_written(result, tmp_path, metric):
    scale = "metric, from the depth prior" if metric else "arbitrary"
    depth.DepthExporter().export(replace(result, manifest={"scale": scale}), tmp_path)
    prior = FileDepth(FileDepthOptions(path=str(tmp_path / "depth")))
    assert (prior.available, prior.metric) == (3, metric)
    rows, columns = result.keyframes[0].disp.shape
    for keyframe in result.keyframes:
        image, none = torch.zeros(3, rows, columns), torch.zeros(4)
        found = prior.predict(Frame(keyframe.index, 0.0, image, none, f"{keyframe.index + 1}.jpg"))
        assert found is not None
        exact, known = truth(keyframe)
        shown = known & keyframe.depth_valid
        np.testing.assert_array_equal(found.depth.numpy() > 0, shown)
        np.testing.assert_allclose(found.depth.numpy()[shown], exact[shown], rtol=2e-3)
    assert prior.predict(Frame(1, 0.0, image, none, "000000.png")) is None


def test_numbers(result, tmp_path):
    (path,) = depth.DepthExporter(png=False).export(result, tmp_path)
    assert path == tmp_path / "depth" / "depth.npz"
    keyframes = result.keyframes
    with np.load(path) as data:
        assert set(data) == {"depth", "valid", "index", "time", "T_wc", "intrinsics"}
        assert (data["depth"].dtype, data["depth"].shape) == (np.float32, (3, 6, 8))
        assert data["index"].tolist() == [0, 2, 4]
        assert data["time"].tolist() == [keyframe.time for keyframe in keyframes]
        np.testing.assert_array_equal(data["T_wc"], [keyframe.T_wc for keyframe in keyframes])
        for n, keyframe in enumerate(keyframes):
            exact, known = truth(keyframe)
            np.testing.assert_allclose(data["depth"][n], exact, rtol=1e-6)
            np.testing.assert_array_equal(data["valid"][n], known & keyframe.depth_valid)


def test_the_intrinsics_are_those_of_the_grid(result, tmp_path):
    """A point back-projected from a cell is the one back-projected from its pixel."""
    depth.DepthExporter(png=False).export(result, tmp_path)
    with np.load(tmp_path / "depth" / "depth.npz") as data:
        fx, fy, cx, cy = data["intrinsics"][1]
    big = result.keyframes[1].intrinsics
    pixels = Grid(6, 8, result.stride, result.offset).centres().numpy()
    y, x = np.mgrid[:6, :8]
    np.testing.assert_allclose((x - cx) / fx, (pixels[..., 0] - big[2]) / big[0], atol=1e-12)
    np.testing.assert_allclose((y - cy) / fy, (pixels[..., 1] - big[3]) / big[1], atol=1e-12)


@pytest.mark.parametrize(
    ("median", "scale"),
    [(1.0, 1e-3), (9.99, 1e-3), (10.0, 1e-2), (0.999, 1e-4), (2e-7, 1e-10), (4e6, 1e3)],
)
def test_the_scale_follows_the_median(median, scale):
    assert depth.scale_for(np.array([median / 2, median, median * 50], np.float64)) == scale
    assert depth.scale_for(np.zeros(0, np.float32)) == 0.001


def test_what_does_not_fit_is_unknown(result, tmp_path):
    values = np.array([[1e-9, 0.0005, 1.0, 65.535, 65.6, 1e30]], np.float32)
    read = depth.encode(values, np.ones_like(values, bool), 0.001)
    assert read.tolist() == [[1, 1, 1000, 65535, 0, 0]]
    assert depth.encode(values, np.zeros_like(values, bool), 0.001).max() == 0
    # A fixed scale is taken as it is, and what is lost is counted.
    depth.DepthExporter(npz=False, scale=1e-5).export(result, tmp_path)
    facts = json.loads((tmp_path / "depth" / "scale.json").read_text())
    lost = 0
    for keyframe in result.keyframes:
        exact, known = truth(keyframe)
        far = known & keyframe.depth_valid & (exact > 0.65535)
        assert picture(tmp_path / "depth", keyframe)[far].max(initial=0) == 0
        lost += far.sum()
    assert (facts["scale"], facts["cells_too_far"]) == (1e-5, lost)
    assert lost > 0
    with pytest.raises(ValueError, match="scale must be"):
        depth.DepthOptions(scale=float("nan"))


def test_nothing_seen_consistently(result, tmp_path):
    none = [replace(k, depth_valid=np.zeros_like(k.depth_valid)) for k in result.keyframes]
    depth.DepthExporter().export(replace(result, keyframes=tuple(none)), tmp_path)
    facts = json.loads((tmp_path / "depth" / "scale.json").read_text())
    assert (facts["scale"], facts["median_depth"]) == (0.001, None)
    assert all(picture(tmp_path / "depth", k).max() == 0 for k in none)
    with np.load(tmp_path / "depth" / "depth.npz") as data:
        assert not data["valid"].any()
        assert (data["depth"] > 0).any()


def test_nothing_is_written_where_there_is_nothing(result, tmp_path):
    assert depth.DepthExporter().export(replace(result, keyframes=()), tmp_path) == []
    assert depth.DepthExporter(png=False, npz=False).export(result, tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_the_way(result, tmp_path):
    (tmp_path / "depth").write_text("a file")
    with pytest.raises(UsageError, match=r"cannot make the folder .*depth"):
        depth.DepthExporter().export(result, tmp_path)


def test_two_exports_give_the_same_bytes(result, tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"
    for folder in (first, second):
        folder.mkdir()
        depth.DepthExporter().export(result, folder)
    for path in (first / "depth").iterdir():
        assert path.read_bytes() == (second / "depth" / path.name).read_bytes()


def test_pictures_at_full_size(result, tmp_path):
    first, *others = result.keyframes
    cells = first.disp.shape
    fine = np.random.default_rng(0).uniform(0.2, 0.4, (8 * cells[0], 8 * cells[1]))
    first = replace(first, disp_full=fine.astype(np.float32))
    result = replace(result, keyframes=(first, *others), stride=8, offset=0.0)
    exporter = depth.COMPONENT.factory(depth.DepthOptions(full=True), None)
    written = exporter.export(result, tmp_path)
    folder = tmp_path / "depth"
    assert [p for p in written if p.parent.name == "full"] == [folder / "full" / "000000.png"]
    scale = json.loads((folder / "scale.json").read_text())["scale"]
    values = picture(folder / "full", first)
    assert values.shape == fine.shape
    kept = (np.isfinite(first.disp) & (first.disp > 0) & first.depth_valid).repeat(8, 0)
    kept = kept.repeat(8, 1)
    assert kept.any() and not kept.all()
    assert (values[~kept] == 0).all()
    assert np.allclose(values[kept] * scale, 1 / fine[kept], atol=0.51 * scale)
