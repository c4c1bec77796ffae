"""benchmarks/drawn.py draws clips by lot, the same ones for the same seed."""

import importlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest


@pytest.fixture
def drawn(monkeypatch):
    """The script, which imports those beside it as scripts do."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return importlib.import_module("drawn")


def a_square_crosses(folder, pictures=4):
    """A clip of DATA: a white square that goes to the right, and where it is."""
    for part in ("rgb", "mask"):
        (folder / part).mkdir(parents=True)
    for k in range(pictures):
        mask = np.zeros((48, 64), np.uint8)
        mask[12:40, 10 + 6 * k : 34 + 6 * k] = 255
        cv2.imwrite(str(folder / "mask" / f"{k}.png"), mask)
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), np.dstack([mask] * 3))


@pytest.fixture
def few(drawn, monkeypatch, tmp_path):
    """Short clips of a small room under one mover; the folder of what is pasted."""
    draw = drawn.draw

    def short(rng):
        return replace(draw(rng), size=(64, 48), frames=5, swing=0.0, jpeg=0)

    monkeypatch.setattr(drawn, "draw", short)
    monkeypatch.setattr(drawn, "REAL", ())
    monkeypatch.setattr(drawn, "SCENERY", {})
    monkeypatch.setattr(drawn, "MOVERS", ("square", "other"))
    for name in ("square", "other"):
        a_square_crosses(tmp_path / "data" / name)
    return tmp_path / "data"


def pictures(folder):
    return [cv2.imread(str(path)) for path in sorted(folder.iterdir())]


def test_a_clip_and_the_same_without_what_moves_differ_where_the_mask_says(few, drawn, tmp_path):
    drawn.main([str(few), str(tmp_path / "out"), "--count", "3", "--seed", "4"])
    clips = sorted(p for p in (tmp_path / "out").iterdir() if not p.name.endswith("_static"))
    assert len(clips) == 3
    for clip in clips:
        static = clip.with_name(f"{clip.name}_static")
        assert not (static / "mask").exists()
        for name in ("rgb.txt", "groundtruth.txt", "camera.txt"):
            assert (clip / name).read_bytes() == (static / name).read_bytes()
        masks = np.array(pictures(clip / "mask")).any(axis=-1)
        low, high = drawn.SHARE
        assert len(masks) == 5 and low <= masks.mean() <= high
        for moving, still, mask in zip(
            pictures(clip / "rgb"), pictures(static / "rgb"), masks, strict=True
        ):
            near = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            assert np.array_equal(moving[~near], still[~near])
            assert not np.array_equal(moving[mask], still[mask])


def test_a_seed_draws_the_same_again_and_another_seed_others(few, drawn, tmp_path):
    made = {}
    for name, seed in (("a", "4"), ("b", "4"), ("c", "5")):
        drawn.main([str(few), str(tmp_path / name), "--count", "1", "--seed", seed])
        made[name] = [p.read_bytes() for p in sorted((tmp_path / name).rglob("*.png"))]
    assert made["a"] == made["b"] != made["c"]


def test_exposure_swings_and_jpeg_is_seen(few, drawn):
    one = drawn.draw(np.random.default_rng(1))
    clip = drawn.still(few, one)
    assert all(map(np.array_equal, drawn.filmed(clip, one).pictures, clip.pictures))
    bright = [p.mean() for p in drawn.filmed(clip, replace(one, swing=0.2)).pictures]
    assert max(bright) > 1.1 * min(bright)
    pressed = drawn.filmed(clip, replace(one, jpeg=80)).pictures
    off = np.abs(np.array(pressed, float) - np.array(clip.pictures))
    assert 0 < off.mean() < 8
