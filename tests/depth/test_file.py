"""The depth prior `file`: every way to find a map, every format, and what bad files get."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from droidw.errors import ConfigError, InputError
from droidw.plugin.component import BuildContext
from droidw.slam.frame import Frame
from droidw_plugins.depth._folder import FileDepth, read_depth
from droidw_plugins.depth.file import COMPONENT, FileDepthOptions
from droidw_plugins.depth.none import COMPONENT as NONE

CPU = BuildContext(torch.device("cpu"))


def _frame(
    index: int = 0, time: float = 0.0, name: str = "", size: tuple[int, int] = (4, 6)
) -> Frame:
    return Frame(index, time, torch.zeros(3, *size), torch.tensor([5.0, 5.0, 2.5, 1.5]), name)


def _prior(path: Path, **options: object) -> FileDepth:
    made = FileDepthOptions(path=str(path), **options)  # type: ignore[arg-type]
    found = COMPONENT.factory(made, CPU)
    assert isinstance(found, FileDepth)
    return found


def _png(path: Path, millimetres: int, size: tuple[int, int] = (4, 6)) -> None:
    cv2.imwrite(str(path), np.full(size, millimetres, np.uint16))


def _depth(prior: FileDepth, frame: Frame) -> float | None:
    found = prior.predict(frame)
    return None if found is None else float(found.depth.mean())


def test_numbered_pngs_by_index(tmp_path: Path) -> None:
    for number in (2, 9, 10):
        _png(tmp_path / f"{number:05d}.png", 100 * number)
    prior = _prior(tmp_path)
    assert prior.metric
    assert prior.available == 3
    assert _depth(prior, _frame(index=9)) == pytest.approx(0.9)
    assert _depth(prior, _frame(index=10)) == pytest.approx(1.0)
    assert _depth(prior, _frame(index=3)) is None
    assert (prior.found, prior.missing) == (2, 1)


def test_other_names_by_place_in_natural_order(tmp_path: Path) -> None:
    for number in (9, 10, 100):
        _png(tmp_path / f"depth_{number}.png", number)
    prior = _prior(tmp_path, scale=1.0)
    assert [_depth(prior, _frame(index=i)) for i in range(4)] == [9.0, 10.0, 100.0, None]


def test_by_file_stem(tmp_path: Path) -> None:
    _png(tmp_path / "frame_b.png", 3000)
    _png(tmp_path / "frame_a.png", 1000)
    prior = _prior(tmp_path, match="name")
    assert _depth(prior, _frame(index=0, name="rgb/frame_b.jpg")) == pytest.approx(3.0)
    assert _depth(prior, _frame(index=0, name="frame_c.jpg")) is None
    assert _depth(prior, _frame(index=0)) is None
    auto = _prior(tmp_path)
    assert _depth(auto, _frame(index=0, name="frame_b.jpg")) == pytest.approx(3.0)
    assert _depth(auto, _frame(index=0, name="other.jpg")) is None  # not that of another frame


def test_a_frame_without_a_map_does_not_get_that_of_another(tmp_path: Path) -> None:
    for number in (0, 10, 20):
        _png(tmp_path / f"frame_{number:04d}.png", 100 + number)
    prior = _prior(tmp_path, scale=1.0)
    names = [f"frame_{number:04d}.jpg" for number in (1, 2, 10, 20, 21)]
    found = [_depth(prior, _frame(index=i, name=name)) for i, name in enumerate(names, start=1)]
    assert found == [None, None, 110.0, 120.0, None]


def test_numbers_of_pictures_that_begin_anywhere(tmp_path: Path) -> None:
    for number in (100, 110, 120):
        _png(tmp_path / f"{number:06d}.png", number)
    prior = _prior(tmp_path, scale=1.0)
    # pictures 000000, 000001, ... of which every tenth has a map
    assert _depth(prior, _frame(index=0, name="000000.png")) is None
    assert _depth(prior, _frame(index=110, name="000110.png")) == pytest.approx(110.0)
    assert _depth(prior, _frame(index=200, name="000200.png")) is None


@pytest.mark.parametrize("match", ["auto", "index"])
def test_maps_that_are_numbered_from_1(tmp_path: Path, match: str) -> None:
    for number in (1, 2, 3):
        _png(tmp_path / f"{number:06d}.png", number)
    prior = _prior(tmp_path, scale=1.0, match=match)
    # as pictures of a video are called, which are counted from 0
    found = [_depth(prior, _frame(index=i, name=f"{i:06d}")) for i in range(4)]
    assert found == [1.0, 2.0, 3.0, None]


def test_names_that_are_seconds(tmp_path: Path) -> None:
    for stamp in ("1305.150", "1305.183"):
        _png(tmp_path / f"{stamp}.png", int(stamp[-3:]))
    for match in ("auto", "time"):
        prior = _prior(tmp_path, scale=1.0, match=match)
        near = _frame(index=9, time=1305.185, name="1305.185.png")
        far = _frame(index=10, time=1306.5, name="1306.500.png")
        assert [_depth(prior, near), _depth(prior, far)] == [183.0, None]


def test_nearest_stamp_of_a_list(tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    _png(tmp_path / "depth" / "a.png", 1000)
    _png(tmp_path / "depth" / "b.png", 2000)
    (tmp_path / "depth.txt").write_text(
        "# time file\n0.50 depth/b.png\n\n0.10 depth/a.png\n0.90 depth/gone.png\n"
    )
    for path in (tmp_path, tmp_path / "depth.txt"):
        prior = _prior(path)
        assert _depth(prior, _frame(time=0.11)) == pytest.approx(1.0)
        assert _depth(prior, _frame(time=0.485)) == pytest.approx(2.0)
        assert _depth(prior, _frame(time=0.3)) is None
        assert _depth(prior, _frame(time=0.9)) is None  # listed, but the file is not there
        assert _depth(prior, _frame(time=-5.0)) is None


def test_missing_map_warns_once_with_the_count(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _png(tmp_path / "000000.png", 1000)
    prior = _prior(tmp_path)
    with caplog.at_level(logging.WARNING):
        for index in (5, 6, 7):
            assert prior.predict(_frame(index=index)) is None
    assert len(caplog.records) == 1
    assert "frame 5" in caplog.text
    assert "1 maps are available" in caplog.text
    assert prior.missing == 3


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16, np.uint16])
def test_arrays_are_taken_as_they_are(tmp_path: Path, dtype: type) -> None:
    values = np.array([[1, 2], [0, 4]], dtype)
    np.save(tmp_path / "a.npy", values)
    np.savez(tmp_path / "b.npz", depth=values[None], other=np.zeros(3))
    np.savez_compressed(tmp_path / "c.npz", anything=values[..., None])
    for name in ("a.npy", "b.npz", "c.npz"):
        found = read_depth(tmp_path / name, scale=1000.0)
        assert found.dtype == np.float32
        assert found.tolist() == [[1, 2], [0, 4]]


def test_unusable_values_become_unknown_and_far_ones_can(tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", np.array([[np.nan, np.inf], [-1.0, 3.0]], np.float32))
    assert read_depth(tmp_path / "0.npy", 1.0).tolist() == [[0, 0], [0, 3]]
    found = _prior(tmp_path, max_depth=2.0).predict(_frame(size=(2, 2)))
    assert found is not None
    assert float(found.depth.max()) == 0.0


def test_other_sizes_are_resized_to_the_nearest_value(tmp_path: Path) -> None:
    step = np.array([[1000, 1000, 5000, 5000]] * 2, np.uint16)
    cv2.imwrite(str(tmp_path / "0.png"), step)
    for size in ((4, 8), (2, 4), (1, 2), (3, 5)):
        found = _prior(tmp_path).predict(_frame(size=size))
        assert found is not None
        assert found.depth.shape == size
        assert set(found.depth.unique().tolist()) == {1.0, 5.0}  # no depth in between
        assert found.depth[0, 0] == 1.0
        assert found.depth[-1, -1] == 5.0


def test_bad_folders_and_lists_are_sentences(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"depth\.options\.path=FOLDER"):
        COMPONENT.factory(FileDepthOptions(), CPU)
    _png(tmp_path / "one.png", 1)
    with pytest.raises(InputError, match=r"one\.png is one depth map") as refused:
        _prior(tmp_path / "one.png")
    assert f"depth.options.path={tmp_path}" in refused.value.hint
    (tmp_path / "one.png").unlink()
    with pytest.raises(InputError, match="there is no folder"):
        _prior(tmp_path / "absent")
    with pytest.raises(InputError, match="holds no depth maps"):
        _prior(tmp_path)
    _png(tmp_path / "0.png", 1)
    with pytest.raises(ConfigError, match="'time' needs"):
        _prior(tmp_path, match="time")
    for line in ("abc 0.png", "0.5", "nan 0.png"):
        (tmp_path / "depth.txt").write_text(f"0.1 0.png\n{line}\n")
        with pytest.raises(InputError, match="line 2"):
            _prior(tmp_path)


def test_bad_maps_are_sentences(tmp_path: Path) -> None:
    cases: dict[str, str] = {}
    (tmp_path / "text.png").write_text("no picture")
    cases["text.png"] = "cannot be read"
    cv2.imwrite(str(tmp_path / "eight.png"), np.zeros((4, 4), np.uint8))
    cases["eight.png"] = "8 bits"
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((4, 4, 3), np.uint16))
    cases["colour.png"] = "shape"
    (tmp_path / "empty.npy").write_bytes(b"")
    cases["empty.npy"] = "cannot be read"
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    cases["objects.npy"] = "cannot be read"
    np.save(tmp_path / "words.npy", np.array([["a"]]))
    cases["words.npy"] = "not numbers"
    np.savez(tmp_path / "two.npz", a=np.zeros((2, 2)), b=np.zeros((2, 2)))
    cases["two.npz"] = "none is called 'depth'"
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04 cut")
    cases["cut.npz"] = "cannot be read"
    for name, message in cases.items():
        with pytest.raises(InputError, match=message):
            read_depth(tmp_path / name, 1000.0)


def test_none_knows_nothing() -> None:
    prior = NONE.factory(NONE.options(), CPU)
    assert prior.predict(_frame()) is None
    assert not prior.metric


def test_the_maps_of_a_named_sequence(tmp_path: Path) -> None:
    """Their folder and their scale are in the table; times tell which belongs to a picture."""
    folder = tmp_path / "Bonn" / "rgbd_bonn_balloon"
    (folder / "depth").mkdir(parents=True)
    _png(folder / "depth" / "a.png", 10000)
    (folder / "depth.txt").write_text("# depth maps\n7.51 depth/a.png\n")
    context = BuildContext(torch.device("cpu"), data_dir=tmp_path)

    def prior(path: str, **options: float) -> FileDepth:
        return COMPONENT.factory(FileDepthOptions(path=path, **options), context)  # type: ignore

    assert _depth(prior("bonn:balloon"), _frame(time=7.5)) == pytest.approx(2.0)
    assert _depth(prior("bonn:balloon", scale=1000.0), _frame(time=7.5)) == pytest.approx(10.0)
    with pytest.raises(InputError, match="has no sequence 'baloon'"):
        prior("bonn:baloon")
    with pytest.raises(ConfigError, match="droidw:downtown1 has no depth maps"):
        prior("droidw:downtown1")
    with pytest.raises(InputError, match=r"there is no folder or list .*rgbd_bonn_crowd"):
        prior("bonn:crowd")


def test_depth_of_dycheck_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "DyCheck" / "apple" / "depth" / "1x"
    folder.mkdir(parents=True)
    for number in (0, 3):
        np.save(folder / f"0_{number:05d}.npy", np.full((4, 6, 1), 1.0 + number, np.float32))
    context = BuildContext(torch.device("cpu"), data_dir=tmp_path)
    prior = COMPONENT.factory(FileDepthOptions(path="dycheck:apple"), context)
    assert isinstance(prior, FileDepth)
    assert _depth(prior, _frame(index=1, name="0_00003.png")) == pytest.approx(4.0)
