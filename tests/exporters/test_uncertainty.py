"""Exporter `uncertainty`: maps and video read back."""

from __future__ import annotations

import json
from dataclasses import replace

import av
import cv2
import numpy as np
import pytest

from droidw.errors import DroidwError, MissingRequirementError, UsageError
from droidw.eval.mask_files import read_uncertainty
from droidw.eval.masks import score_folder
from droidw.interfaces.exporters import Exporter
from droidw.io.masks import UserMasks
from droidw.slam.frame import RawFrame
from droidw.testing._check_files import sample_result
from droidw.testing.conformance import check_exporter
from droidw_plugins.exporters import _movie, uncertainty
from droidw_plugins.exporters._movie import stamps, write_movie

H, W, STRIDE = 120, 160, 8


@pytest.fixture
def result():
    """Three grey keyframes at uneven times; the right half of the grid is without weight."""
    full = sample_result()
    rng = np.random.default_rng(0)
    weight = np.ones((H // STRIDE, W // STRIDE), np.float32)
    weight[:, W // STRIDE // 2 :] = 0
    keyframes = [
        replace(
            keyframe, time=100 + time, image=np.full((H, W, 3), 120, np.uint8), weight=weight,
            uncertainty=np.where(weight, 0.2, 3).astype(np.float32)
            + rng.uniform(0, 0.5, weight.shape).astype(np.float32),
        )
        for keyframe, time in zip(full.keyframes, (0.5, 0.6, 1.35), strict=True)
    ]  # fmt: skip
    trajectory = replace(full.trajectory, times=100 + full.trajectory.times)
    # Records are in time order by contract; the files do not depend on it.
    return replace(full, keyframes=tuple(keyframes[::-1]), trajectory=trajectory)


def exporter(**options):
    return uncertainty.UncertaintyExporter(uncertainty.UncertaintyOptions(**options))


def decoded(path):
    with av.open(str(path)) as container:
        (stream,) = container.streams
        frames = [(f.time, f.to_ndarray(format="rgb24")) for f in container.decode(stream)]
        return stream.codec_context.name, float(stream.duration * stream.time_base), frames


def test_conformance():
    check_exporter(uncertainty.COMPONENT)


def test_files_and_maps(result, tmp_path):
    made = uncertainty.COMPONENT.factory(uncertainty.UncertaintyOptions(), None)
    assert isinstance(made, Exporter)
    written = made.export(result, tmp_path)
    folder = tmp_path / "uncertainty"
    masks = ["000000.png", "000002.png", "000004.png", "scale.json"]
    names = [*masks[:3], "overlay.mp4", "scale.json"]
    assert sorted(path.name for path in folder.iterdir()) == names
    assert sorted(path.name for path in (tmp_path / "masks").iterdir()) == masks
    assert sorted(written) == [
        *(tmp_path / "masks" / name for name in masks), *(folder / name for name in names)
    ]  # fmt: skip
    facts = json.loads((folder / "scale.json").read_text())
    assert (facts["scale"], facts["stride"], facts["offset"]) == (0.001, STRIDE, 3.5)
    for keyframe in result.keyframes:
        path = folder / f"{keyframe.index:06d}.png"
        assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).dtype == np.uint16
        read = read_uncertainty(path) * facts["scale"]
        np.testing.assert_allclose(read, keyframe.uncertainty, atol=0.000501)


def test_the_evaluation_reads_the_maps(result, tmp_path):
    exporter(video=False).export(result, tmp_path)
    masks = tmp_path / "mask"
    masks.mkdir()
    mask = np.zeros((H, W), np.uint8)
    mask[:, W // 2 :] = 255
    for index in range(5):
        cv2.imwrite(str(masks / f"{index:06d}.png"), mask)
    score = score_folder(tmp_path / "uncertainty", masks)
    assert (score.frames, score.without_mask, score.auc, score.iou) == (3, 0, 1.0, 1.0)


@pytest.mark.parametrize(("below", "edge"), [(0.5, 80), (1.0, 76), (0.25, 82)])
def test_masks_are_where_weight_is_lost(result, tmp_path, below, edge):
    """Cells 9 and 10 lie at 75.5 and 83.5, and the weight falls evenly between them."""
    exporter(maps=False, video=False, mask_below=below).export(result, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["masks"]
    for keyframe in result.keyframes:
        mask = cv2.imread(str(tmp_path / "masks" / f"{keyframe.index:06d}.png"), -1)
        assert mask.dtype == np.uint8 and mask.shape == (H, W)
        assert (mask[:, :edge] == 0).all() and (mask[:, edge:] == 255).all()
    facts = json.loads((tmp_path / "masks" / "scale.json").read_text())
    assert facts["named"] == "index" and facts["picture"] == [W, H]


def test_masks_end_where_the_picture_has_a_contour(result, tmp_path):
    """What moves begins at column 77, and all of the cell from 72 to 79 lost its weight."""
    image = np.full((H, W, 3), (90, 120, 60), np.uint8)
    image[:, 77:] = (140, 120, 60)  # as bright on the whole as it is blue
    weight = np.ones((H // STRIDE, W // STRIDE), np.float32)
    weight[:, 9:] = 0
    keyframes = tuple(replace(k, image=image, weight=weight) for k in result.keyframes)
    for outline, edge in ((True, 77), (False, 72)):
        folder = tmp_path / str(outline)
        folder.mkdir()
        exporter(maps=False, video=False, mask_outline=outline).export(
            replace(result, keyframes=keyframes), folder
        )
        mask = cv2.imread(str(folder / "masks" / "000002.png"), -1)
        assert (mask[:, : edge - 1] == 0).all() and (mask[:, edge + 1 :] == 255).all()


def test_masks_come_back_as_masks_of_the_user(result, tmp_path):
    exporter(maps=False, video=False).export(result, tmp_path)
    masks = UserMasks(tmp_path / "masks", 5, 5)
    # The pictures happen to be counted from 1, so that names would mislead.
    pictures = [RawFrame(k, k / 30, np.zeros((1, 1, 3), np.uint8), f"{k + 1:06d}") for k in (0, 4)]
    for picture in pictures:
        found = masks.of(picture)
        assert found.shape == (H, W) and found[:, 80:].all() and not found[:, :80].any()


def test_values_that_do_not_fit():
    values = np.array([[-1, 0, 0.0005001, 65.5, 65.6], [1e30, np.inf, -np.inf, np.nan, 1]])
    read = uncertainty.encode(values.astype(np.float32))
    assert read.tolist() == [[0, 0, 1, 65500, 65535], [65535, 65535, 0, 65535, 1000]]


def test_the_video_plays_at_the_times_of_the_keyframes(result, tmp_path):
    exporter(maps=False, masks=False).export(result, tmp_path)
    assert [path.name for path in (tmp_path / "uncertainty").iterdir()] == ["overlay.mp4"]
    codec, duration, frames = decoded(tmp_path / "uncertainty" / "overlay.mp4")
    assert codec == "vp9"
    assert [time for time, _ in frames] == pytest.approx([0, 0.1, 0.85], abs=0.002)
    # The gaps are 0.1 and 0.75 s, and the last picture stays for their median.
    assert duration == pytest.approx(0.85 + 0.425, abs=0.003)
    for _, picture in frames:
        assert picture.shape == (H, W, 3)
        kept, lost = picture[10:90, 10:70].mean((0, 1)), picture[10:90, 90:150].mean((0, 1))
        np.testing.assert_allclose(kept, 120, atol=6)
        np.testing.assert_allclose(lost, 0.35 * 120 + 0.65 * np.array([255, 92, 20]), atol=14)
    # The stamp lies in the lower left corner and differs from picture to picture.
    stamps_ = [picture[-14:, :80].astype(int) for _, picture in frames]
    assert all(stamp.max() > 180 for stamp in stamps_)
    assert all(np.abs(a - b).max() > 80 for a, b in zip(stamps_, stamps_[1:], strict=False))


def test_alpha_and_weights_that_are_no_numbers(result, tmp_path):
    blank = np.full((H // STRIDE, W // STRIDE), np.nan, np.float32)
    keyframes = (replace(result.keyframes[0], weight=blank), *result.keyframes[1:])
    bare = replace(result, keyframes=keyframes)
    exporter(maps=False, masks=False, alpha=0.0).export(bare, tmp_path)
    for _, picture in decoded(tmp_path / "uncertainty" / "overlay.mp4")[2]:
        np.testing.assert_allclose(picture[:90].mean((0, 1)), 120, atol=6)
    with pytest.raises(ValueError, match="between 0 and 1"):
        uncertainty.UncertaintyOptions(alpha=1.5)


def test_nothing_is_written_where_there_is_nothing(result, tmp_path):
    assert exporter().export(replace(result, keyframes=()), tmp_path) == []
    assert exporter(maps=False, masks=False, video=False).export(result, tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_stamps_rise():
    assert stamps([7.5]) == ([0], 1000)
    assert stamps([10.0, 10.0, 10.0001, 9.0, 10.5]) == ([0, 1, 2, 3, 500], 1)
    # Times of day in seconds keep their milliseconds.
    assert stamps([1341846313.592, 1341846313.692, 1341846313.792]) == ([0, 100, 200], 100)


@pytest.mark.parametrize("codec", _movie.CODECS)
@pytest.mark.parametrize("size", [(33, 47), (64, 48)], ids=["odd", "even"])
def test_every_encoder_there_is(tmp_path, codec, size):
    path = tmp_path / "clip.mp4"
    grey = [np.full((*size, 3), value, np.uint8) for value in (40, 120, 200)]
    if codec not in av.codecs_available:
        with pytest.raises(MissingRequirementError, match="has no encoder"):
            write_movie(path, grey, [0, 1, 2], [codec])
        assert list(tmp_path.iterdir()) == []
        return
    assert write_movie(path, iter(grey), [3.0, 3.04, 3.5], ["none-such", codec]) == codec
    assert [entry.name for entry in tmp_path.iterdir()] == ["clip.mp4"]
    _, _, frames = decoded(path)
    assert [time for time, _ in frames] == pytest.approx([0, 0.04, 0.5], abs=0.002)
    for picture, (_, read) in zip(grey, frames, strict=True):
        assert read.shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
        np.testing.assert_allclose(read.mean(), picture.mean(), atol=8)


def test_without_an_encoder_the_maps_are_there(result, tmp_path, monkeypatch):
    monkeypatch.setattr(_movie.av, "codecs_available", {"png"})
    with pytest.raises(MissingRequirementError, match=r"overlay\.mp4: this build of PyAV"):
        exporter().export(result, tmp_path)
    assert len(list((tmp_path / "uncertainty").glob("*.png"))) == 3
    assert not (tmp_path / "uncertainty" / "overlay.mp4").exists()


def test_a_folder_in_the_way(result, tmp_path):
    (tmp_path / "uncertainty").write_text("a file")
    with pytest.raises(UsageError, match=r"cannot make the folder .*uncertainty"):
        exporter().export(result, tmp_path)


def test_two_exports_give_the_same_bytes(result, tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"
    for folder in (first, second):
        folder.mkdir()
        exporter().export(result, folder)
    for path in (first / "uncertainty").iterdir():
        assert path.read_bytes() == (second / "uncertainty" / path.name).read_bytes()


def test_an_encoder_that_fails_leaves_no_file(result, tmp_path, monkeypatch):
    def fail(*_):
        raise av.error.ExternalError(1, "no luck")

    monkeypatch.setattr(_movie, "_encode", fail)
    with pytest.raises(DroidwError, match=r"overlay\.mp4: the encoder \S+ failed: .*no luck"):
        exporter(maps=False, masks=False).export(result, tmp_path)
    assert list((tmp_path / "uncertainty").iterdir()) == []


def test_the_encoders_that_are_tried_are_free_to_use():
    """x264 and x265 are in PyAV's wheel, and under the GPL."""
    assert not {"libx264", "libx264rgb", "libx265"} & set(_movie.CODECS)
    # What a run on the pinned wheel uses, browsers show.
    assert _movie.CODECS[0] == "libvpx-vp9" and "libvpx-vp9" in av.codecs_available
