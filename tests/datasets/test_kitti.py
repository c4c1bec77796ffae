"""Reader `kitti`: times by number, truth moved to the camera of the pictures."""

from __future__ import annotations

import numpy as np
import pytest

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw_plugins.datasets.kitti import COMPONENT


@pytest.fixture
def reader():
    return COMPONENT.factory(COMPONENT.options(), None)


def test_times_camera_and_truth(reader, trees, data):
    folder = trees.kitti(data / "KITTI")
    assert reader.recognises("kitti:05") and reader.recognises(str(folder))
    source = reader.open("kitti:05", Selection())
    frames = list(source.frames())
    np.testing.assert_allclose([f.time for f in frames], np.arange(6) * 0.1037)
    assert (source.camera.fx, source.camera.cx, source.camera.width) == (70.7, 60.0, 124)
    np.testing.assert_allclose(source.truth.times, [f.time for f in frames])
    # camera 2 stands 6 cm to the left of what camera 0 calls its origin
    wanted = np.column_stack([np.full(6, -0.06), np.zeros(6), np.arange(6)])
    np.testing.assert_allclose(source.truth.centres, wanted, atol=1e-9)


def test_the_grey_camera_serves_where_there_is_no_other(reader, trees, data):
    folder = trees.kitti(data / "KITTI", "00")
    (folder / "image_2").rename(folder / "image_0")
    source = reader.open("kitti:00", Selection())
    np.testing.assert_allclose(source.truth.centres[:, 0], 0)


def test_gaps_bad_rows_and_missing_files(reader, trees, data):
    folder = trees.kitti(data / "KITTI")
    (folder / "image_2" / "000002.png").unlink()
    rows = (data / "KITTI" / "poses" / "05.txt").read_text().splitlines()
    rows[3], rows[4] = "nan " * 12, "1 2 3"
    (data / "KITTI" / "poses" / "05.txt").write_text("\n".join(rows) + "\n")
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n0.4\n")
    source = reader.open(str(folder), Selection())
    frames = list(source.frames())
    np.testing.assert_allclose([f.time for f in frames], [0.0, 0.1, 0.3, 0.4])
    np.testing.assert_allclose(source.truth.centres[:, 2], [0, 1])
    assert source.skipped == 1 and any("2 bad rows" in text for text in source.problems)
    (folder / "calib.txt").write_text("P2: 1 0 0 0 0 1 0 0 0 0 0 0\n")
    assert reader.open(str(folder), Selection()).camera is None
    (folder / "calib.txt").write_text("P2: 1 2 3\n")
    assert reader.open(str(folder), Selection()).camera is None
    (data / "KITTI" / "poses" / "05.txt").unlink()
    assert reader.open(str(folder), Selection()).truth is None


def test_what_is_missing_is_said(reader, data, tmp_path):
    with pytest.raises(InputError, match="has no sequence '99'"):
        reader.open("kitti:99", Selection())
    with pytest.raises(InputError, match="is not on disk") as error:
        reader.open("kitti:07", Selection())
    assert "by hand from https://www.cvlibs.net" in error.value.hint
    with pytest.raises(InputError, match="has no folder of pictures"):
        reader.open(str(tmp_path), Selection())
    (tmp_path / "image_0").mkdir()
    (tmp_path / "times.txt").write_text("")
    with pytest.raises(InputError, match="no picture has a time"):
        reader.open(str(tmp_path), Selection())
