"""benchmarks/variants.py keeps scene and camera in step when it mirrors and reverses them."""

import importlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from droidw.geometry.se3 import act, inv


@pytest.fixture
def variants(monkeypatch):
    """The script, which imports the one beside it as scripts do."""
    folder = Path(__file__).resolve().parents[2] / "benchmarks"
    monkeypatch.syspath_prepend(str(folder))
    return importlib.import_module("variants")


@pytest.fixture
def clip(variants):
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(3, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    poses = np.concatenate([rng.normal(size=(3, 3)), quaternions], axis=1)
    size = (240, 320)
    pictures = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for _ in range(3)]
    masks = [rng.random(size) > 0.7 for _ in range(3)]
    pinhole = (160.0, 150.0, 163.0, 119.5)
    return variants.Clip(pictures, masks, np.array([1.0, 1.1, 1.3]), poses, pinhole)


def seen(pose, pinhole, point):
    """Pixel of a point of the world, by a pose camera to world."""
    at = act(inv(torch.from_numpy(pose)), torch.from_numpy(point)).numpy()
    fx, fy, cx, cy = pinhole
    return np.array([fx * at[0] / at[2] + cx, fy * at[1] / at[2] + cy])


def test_a_mirrored_camera_sees_the_mirrored_world(clip):
    mirrored = clip.mirrored()
    width = clip.pictures[0].shape[1]
    for k, point in enumerate(np.random.default_rng(1).normal(size=(3, 3))):
        before = seen(clip.poses[k], clip.pinhole, point)
        after = seen(mirrored.poses[k], mirrored.pinhole, point * (-1, 1, 1))
        assert np.allclose(after, [width - 1 - before[0], before[1]])
    assert np.array_equal(mirrored.pictures[1], clip.pictures[1][:, ::-1])
    assert np.array_equal(mirrored.masks[1], clip.masks[1][:, ::-1])


def test_in_reverse_what_belongs_together_stays_together(clip):
    back = clip.reversed()
    assert np.allclose(back.times, [1.0, 1.2, 1.3])
    assert np.array_equal(back.poses[0], clip.poses[2])
    assert np.array_equal(back.pictures[0], clip.pictures[2])
    assert np.array_equal(back.masks[0], clip.masks[2])


def test_what_is_written_can_be_read_again(clip, tmp_path, variants):
    clip.write(tmp_path / "clip")
    again = variants.read_clip(tmp_path / "clip", (320, 240))
    assert np.allclose(again.poses, clip.poses, atol=1e-6) and np.allclose(again.times, clip.times)
    assert np.allclose(again.pinhole, clip.pinhole)
    assert all(np.array_equal(a, b) for a, b in zip(again.pictures, clip.pictures, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(again.masks, clip.masks, strict=True))


def test_a_picture_without_a_pose_is_refused(clip, tmp_path, variants):
    clip.write(tmp_path / "clip")
    truth = tmp_path / "clip" / "groundtruth.txt"
    truth.write_text("\n".join(truth.read_text().splitlines()[:2]) + "\n")
    with pytest.raises(SystemExit, match="true pose"):
        variants.read_clip(tmp_path / "clip", (320, 240))


def test_all_of_them_are_written(clip, tmp_path, variants, monkeypatch, capsys):
    clip.write(tmp_path / "data" / "walk")
    moves = np.zeros((clip.pictures[0].shape[0], clip.pictures[0].shape[1]), bool)
    moves[50:90, 100:160] = True
    for part in ("rgb", "mask"):
        (tmp_path / "data" / "dog" / part).mkdir(parents=True)
    for k in range(2):
        cv2.imwrite(
            str(tmp_path / f"data/dog/rgb/{k}.png"), np.full((*moves.shape, 3), 9, np.uint8)
        )
        cv2.imwrite(str(tmp_path / f"data/dog/mask/{k}.png"), moves.astype(np.uint8) * 255)
    monkeypatch.setattr(variants, "CLIPS", (("walk_dog", "walk", "dog"),))
    variants.main([str(tmp_path / "data"), str(tmp_path / "out")])
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    ends = ("", "_mirrored", "_reversed", "_reversed_mirrored")
    assert names == [f"walk_dog{end}" for end in ends]
    picture = cv2.imread(str(tmp_path / "out/walk_dog_mirrored/rgb/000000.png"))
    assert (picture[:, ::-1][moves] == 9).all() and not (picture[:, ::-1][~moves] == 9).all()
    assert "walk_dog: 3 pictures" in capsys.readouterr().out


def test_another_size_sees_the_same(clip, tmp_path, variants, monkeypatch):
    clip.write(tmp_path / "data" / "walk")
    monkeypatch.setattr(variants, "CLIPS", (("walk", "walk", ""),))
    out = tmp_path / "out"
    variants.main([str(tmp_path / "data"), str(out), "--size", "160x120"])
    half = variants.read_clip(out / "walk_mirrored", (160, 120))
    assert half.size == (160, 120)
    assert half.pinhole == pytest.approx((80.0, 75.0, 159 - 81.25, 59.5))
    assert "width 160\nheight 120\n" in (out / "walk" / "camera.txt").read_text()


@pytest.mark.parametrize("size", ["160", "160x", "0x120", "ax9"])
def test_what_is_no_size_is_refused(tmp_path, variants, capsys, size):
    with pytest.raises(SystemExit):
        variants.main([str(tmp_path), str(tmp_path / "out"), "--size", size])
    assert "write WIDTHxHEIGHT" in capsys.readouterr().err
