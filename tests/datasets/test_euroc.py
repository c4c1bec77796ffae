"""Reader `euroc`: nanoseconds, the camera on its mount, and damaged rows."""

from __future__ import annotations

import numpy as np
import pytest

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw_plugins.datasets.euroc import COMPONENT

START = 1403636579.763555584


@pytest.fixture
def reader():
    return COMPONENT.factory(COMPONENT.options(), None)


def test_times_camera_and_truth(reader, trees, data):
    folder = trees.euroc(data / "EuRoC" / "MH_01_easy")
    assert reader.recognises("euroc:MH_01_easy")
    assert reader.recognises(str(folder)) and reader.recognises(str(folder / "mav0"))
    source = reader.open("euroc:MH_01_easy", Selection())
    frames = list(source.frames())
    np.testing.assert_allclose([f.time - START for f in frames], np.arange(6) / 20, atol=1e-6)
    camera = source.camera
    assert (camera.fx, camera.cy, camera.model) == (458.654, 248.375, "opencv")
    assert camera.distortion[0] == -0.28340811
    # the body moves along x; the camera sits at (-0.02, -0.06, 0.01), turned 90 degrees about z
    wanted = [[i / 20 - 0.02, -0.06, 0.01] for i in range(6)]
    np.testing.assert_allclose(source.truth.centres, wanted, atol=1e-9)
    turned = np.array([0, 0, 0.5**0.5, 0.5**0.5])
    np.testing.assert_allclose(source.truth.T_wc[:, 3:], [turned] * 6, atol=1e-9)


def test_damaged_rows_cost_themselves_alone(reader, trees, data):
    mav = trees.euroc(data / "EuRoC" / "V1_01_easy") / "mav0"
    listing = mav / "cam0" / "data.csv"
    listing.write_text(listing.read_text() + "rubbish,x.png\n12\n")
    states = mav / "state_groundtruth_estimate0" / "data.csv"
    rows = states.read_text().splitlines()
    rows[11] = rows[11].replace(",1,0,0,0,", ",nan,0,0,0,")
    rows[21] = rows[21].replace(",1,0,0,0,", ",0,0,0,0,")
    states.write_text("\n".join([*rows, rows[-1]]) + "\n")
    source = reader.open("euroc:V1_01_easy", Selection())
    assert len(list(source.frames())) == 6 and source.skipped == 2
    assert np.isfinite(source.truth.T_wc).all() and any("2 bad rows" in t for t in source.problems)


@pytest.mark.parametrize(
    "sensor",
    [
        "",
        "a: [",
        "intrinsics: [1, 2]\nT_BS: {data: [1]}",
        "T_BS: [1, 0]",
        "intrinsics: [1, 1, 1, .nan]",
    ],
)
def test_an_unusable_calibration_is_told(reader, trees, data, sensor):
    mav = trees.euroc(data / "EuRoC" / "V1_01_easy") / "mav0"
    (mav / "cam0" / "sensor.yaml").write_text(sensor)
    source = reader.open("euroc:V1_01_easy", Selection())
    assert source.camera is None and source.truth is None
    assert any("camera is unknown" in text for text in source.problems)


def test_what_is_missing_is_said(reader, data, tmp_path):
    with pytest.raises(InputError, match="has no sequence 'MH_1'") as error:
        reader.open("euroc:MH_1", Selection())
    assert "MH_01_easy" in error.value.hint
    with pytest.raises(InputError, match="no such file"):
        reader.open(str(tmp_path), Selection())
    (tmp_path / "cam0").mkdir()
    (tmp_path / "cam0" / "data.csv").write_text("#timestamp [ns],filename\n")
    with pytest.raises(InputError, match="names no picture"):
        reader.open(str(tmp_path), Selection())
