"""Exporters `trajectory` and `ply`: the files, and what other programs make of them."""

from __future__ import annotations

import numpy as np
import pytest

from droidw.geometry.camera import Camera
from droidw.interfaces.exporters import Exporter
from droidw.io.tum import read_tum
from droidw.plugin.component import NoOptions
from droidw.slam.frame import CloudPoints, KeyframeRecord, RunResult, Trajectory
from droidw_plugins.exporters import ply, trajectory


def keyframe(index, time):
    blank = np.zeros((3, 4), np.float32)
    return KeyframeRecord(
        index=index, time=time, name=str(index), image=np.zeros((24, 32, 3), np.uint8),
        T_wc=np.array([index, 0, 0, 0, 0, 0, 1.0]), intrinsics=np.ones(4), disp=blank,
        depth_valid=blank > 0, uncertainty=blank, weight=blank,
    )  # fmt: skip


@pytest.fixture
def result():
    rng = np.random.default_rng(0)
    poses = np.hstack([rng.normal(size=(10, 3)), np.tile([0, 0, 0, 1.0], (10, 1))])
    xyz = rng.normal(size=(100, 3)).astype(np.float32)
    xyz[7, 1] = np.nan
    return RunResult(
        trajectory=Trajectory(100 + np.arange(10) / 30, poses),
        keyframes=(keyframe(6, 100.2), keyframe(0, 100.0)),
        cloud=CloudPoints(xyz, rng.integers(0, 256, (100, 3), dtype=np.uint8)),
        camera=Camera(32, 24, 30, 30, 15.5, 11.5),
        stride=8,
        offset=3.5,
        source="made up",
    )


def test_both_trajectories_are_written(result, tmp_path):
    exporter = trajectory.COMPONENT.factory(trajectory.TrajectoryOptions(), None)
    assert isinstance(exporter, Exporter)
    written = exporter.export(result, tmp_path)
    assert [path.name for path in written] == ["trajectory.tum", "keyframes.tum"]
    everything = read_tum(written[0])
    np.testing.assert_array_equal(everything.times, result.trajectory.times)
    np.testing.assert_allclose(everything.T_wc, result.trajectory.T_wc, rtol=1e-8)
    keyframes = read_tum(written[1])
    assert keyframes.times.tolist() == [100.0, 100.2]
    assert keyframes.centres[:, 0].tolist() == [0, 6]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["keyframes.tum", "trajectory.tum"]


def test_the_header_is_an_option_and_no_keyframes_are_no_error(result, tmp_path):
    bare = RunResult(
        trajectory=result.trajectory, keyframes=(), cloud=result.cloud, camera=result.camera,
        stride=8, offset=3.5, source="",
    )  # fmt: skip
    options = trajectory.TrajectoryOptions(header=False)
    trajectory.COMPONENT.factory(options, None).export(bare, tmp_path)
    assert (tmp_path / "keyframes.tum").read_text() == ""
    assert (tmp_path / "trajectory.tum").read_text().startswith("100.000000 ")


def read_ply(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    kinds = {"float": "<f4", "uchar": "u1"}
    fields = [line.split()[1:] for line in lines if line.startswith("property")]
    table = np.frombuffer(body, dtype=[(name, kinds[kind]) for kind, name in fields])
    return lines, table


def test_the_cloud_is_binary_and_finite(result, tmp_path):
    exporter = ply.COMPONENT.factory(NoOptions(), None)
    assert isinstance(exporter, Exporter)
    (path,) = exporter.export(result, tmp_path)
    lines, table = read_ply(path)
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 99" in lines
    assert table.dtype.names == ("x", "y", "z", "red", "green", "blue")
    keep = np.arange(100) != 7
    xyz = np.stack([table[name] for name in "xyz"], axis=-1)
    np.testing.assert_array_equal(xyz, result.cloud.xyz[keep])
    rgb = np.stack([table[name] for name in ("red", "green", "blue")], axis=-1)
    np.testing.assert_array_equal(rgb, result.cloud.rgb[keep])


def test_an_empty_cloud_is_a_file_without_points(result, tmp_path):
    empty = CloudPoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    bare = RunResult(
        trajectory=result.trajectory, keyframes=(), cloud=empty, camera=result.camera,
        stride=8, offset=3.5, source="",
    )  # fmt: skip
    (path,) = ply.PlyExporter().export(bare, tmp_path)
    lines, table = read_ply(path)
    assert "element vertex 0" in lines
    assert len(table) == 0
