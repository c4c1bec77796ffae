"""Reader `droidw`: times in names, truth of another clock, and the YouTube clips."""

from __future__ import annotations

import numpy as np
import pytest

from droidw.errors import InputError
from droidw.interfaces.datasets import Selection
from droidw_plugins.datasets.droidw import COMPONENT, DroidwOptions


@pytest.fixture
def reader():
    return COMPONENT.factory(DroidwOptions(), None)


def test_times_camera_and_truth_at_the_pictures(reader, trees, data):
    trees.walk(data / "DROID-W" / "downtown1")
    source = reader.open("droidw:downtown1", Selection())
    frames = list(source.frames())
    np.testing.assert_allclose(
        [f.time for f in frames], trees.START + np.arange(6) / 10, atol=1e-5, rtol=0
    )
    assert (
        source.camera.fx == pytest.approx(893.342715 * 64 / 1600)
        and source.camera.distortion[4] == -0.020031
    )
    # poses are 30 ms late, and belong to the pictures all the same
    np.testing.assert_array_equal(source.truth.times, [f.time for f in frames])
    np.testing.assert_allclose(source.truth.centres[:, 0], np.arange(6))


def test_satellite_truth_comes_before_that_of_the_lidar(reader, trees, data):
    folder = trees.walk(data / "DROID-W" / "downtown2")
    (folder / "traj_gt_fastlivo.txt").write_text(f"{trees.START} 7 7 7 0 0 0 1\n")
    assert len(reader.open("droidw:downtown2", Selection()).truth) == 6
    (folder / "traj_gt.txt").unlink()
    assert reader.open("droidw:downtown2", Selection()).truth.centres[0, 0] == 7
    (folder / "traj_gt_fastlivo.txt").unlink()
    assert reader.open("droidw:downtown2", Selection()).truth is None


def test_truth_too_far_in_time_is_not_used(trees, data):
    folder = trees.walk(data / "DROID-W" / "downtown3", offset=0.0)
    rows = [f"{trees.START + t} {t} 0 0 0 0 0 1" for t in (0.0, 0.02, 0.55)]
    (folder / "traj_gt.txt").write_text("\n".join(rows) + "\n")
    source = COMPONENT.factory(DroidwOptions(), None).open("droidw:downtown3", Selection())
    # 0.0 serves picture 0; 0.02 is the nearest to picture 1 (80 ms); 0.55 to picture 5 (50 ms)
    np.testing.assert_allclose(source.truth.times - trees.START, [0.0, 0.1, 0.5], atol=1e-5)
    np.testing.assert_allclose(source.truth.centres[:, 0], [0.0, 0.02, 0.55])
    strict = COMPONENT.factory(DroidwOptions(max_difference=0.06), None)
    assert len(strict.open("droidw:downtown3", Selection()).truth) == 2


def test_truth_of_positions_alone(reader, trees, data):
    folder = trees.walk(data / "DROID-W" / "downtown4", columns=4)
    with (folder / "traj_gt.txt").open("a") as stream:
        stream.write(f"{trees.START + 9} nan 0 0\n")
    source = reader.open("droidw:downtown4", Selection())
    np.testing.assert_allclose(source.truth.centres[:, 0], np.arange(6))
    assert any("no orientation" in text for text in source.problems)
    rows = (folder / "traj_gt.txt").read_text().splitlines()
    rows.insert(2, f"{trees.START + 99} 9 9 9")  # one that strays costs no other
    (folder / "traj_gt.txt").write_text("\n".join(rows) + "\n")
    source = reader.open("droidw:downtown4", Selection())
    np.testing.assert_allclose(source.truth.centres[:, 0], np.arange(6))
    (folder / "traj_gt.txt").write_text("a b c d\n")
    source = reader.open("droidw:downtown4", Selection())
    assert source.truth is None and any("not scored" in text for text in source.problems)


def test_odd_names_and_repeated_times(reader, trees, data):
    folder = trees.walk(data / "DROID-W" / "downtown5", count=3)
    trees.picture(folder / "images_anonymized" / "thumbnail.jpg")
    trees.picture(folder / "images_anonymized" / f"{trees.START:.3f}.jpg")
    trees.picture(folder / "images_anonymized" / "nan.jpg")
    source = reader.open("droidw:downtown5", Selection())
    assert len(list(source.frames())) == 3 and source.skipped == 3
    assert reader.recognises(str(folder)) and source.camera is not None


def test_clips(reader, trees, data):
    trees.clip(data / "YouTube" / "giraffe")
    source = reader.open("youtube:giraffe", Selection())
    frames = list(source.frames())
    np.testing.assert_allclose([f.time * 30 for f in frames], [0, 1, 2, 5])
    assert source.camera.fx == pytest.approx(777.217103 / 10) and source.truth is None
    strided = list(reader.open("youtube:giraffe", Selection(stride=2)).frames())
    assert [f.name for f in strided] == ["frame00000.jpg", "frame00002.jpg"]
    trees.picture(data / "YouTube" / "tomyum" / "rgb" / "first.png")
    trees.picture(data / "YouTube" / "tomyum" / "rgb" / "frame7.png")
    odd = list(reader.open("youtube:tomyum", Selection()).frames())
    np.testing.assert_allclose([f.time * 30 for f in odd], [0, 1])
    source = reader.open("youtube:tomyum", Selection())
    assert source.camera is None
    assert any("another shape than the pictures of 64x48" in text for text in source.problems)


def test_what_is_missing_is_said(reader, data, tmp_path):
    for source in ("droidw:downtown1", "youtube:giraffe"):
        assert reader.recognises(source)
        with pytest.raises(InputError, match="is not on disk") as error:
            reader.open(source, Selection())
        assert f"droidw data fetch {source}" in error.value.hint
    with pytest.raises(InputError, match="has no sequence 'downtown8'"):
        reader.open("droidw:downtown8", Selection())
    (tmp_path / "images_anonymized").mkdir()
    with pytest.raises(InputError, match="holds no picture"):
        reader.open(str(tmp_path), Selection())
    (tmp_path / "images_anonymized" / "x.jpg").write_bytes(b"")
    with pytest.raises(InputError, match="no picture with a time"):
        reader.open(str(tmp_path), Selection())
    for wrong in ({"fps": 0.0}, {"max_difference": float("nan")}):
        with pytest.raises(ValueError, match="must be positive"):
            DroidwOptions(**wrong)
