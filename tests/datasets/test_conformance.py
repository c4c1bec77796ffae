"""The readers of files keep what `droidw.testing` asks of every reader."""

from __future__ import annotations

import cv2
import numpy as np

from droidw.testing.conformance import check_dataset_reader
from droidw_plugins.datasets import bonn, droidw, dycheck, folder, tum, video


def pictures(path, count=8):
    rows = []
    for i in range(count):
        (path / "rgb").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path / "rgb" / f"{i}.png"), np.full((48, 64, 3), 9 * i, np.uint8))
        rows.append(f"{100 + i / 30:.4f} rgb/{i}.png\n")
    (path / "rgb.txt").write_text("# timestamp filename\n" + "".join(rows))
    (path / "groundtruth.txt").write_text("100.0 0 0 0 0 0 0 1\n100.1 1 0 0 0 0 0 1\n")
    return path


def test_folder(tmp_path):
    check_dataset_reader(folder.COMPONENT, str(pictures(tmp_path / "clip")))


def test_tum(tmp_path):
    check_dataset_reader(tum.COMPONENT, str(pictures(tmp_path / "rgbd_dataset_freiburg2_xyz")))


def test_video(videos, tmp_path):
    check_dataset_reader(video.COMPONENT, str(videos.write_video(tmp_path / "clip.mp4", count=8)))


def test_named_datasets(trees, data):
    trees.rgbd(data / "Bonn" / "rgbd_bonn_balloon", count=8)
    trees.rgbd(data / "TUM_RGBD" / "rgbd_dataset_freiburg3_walking_xyz", count=8)
    trees.dycheck(data / "DyCheck" / "apple", numbers=range(8))
    trees.walk(data / "DROID-W" / "downtown1", count=8)
    trees.clip(data / "YouTube" / "giraffe", numbers=range(8))
    check_dataset_reader(bonn.COMPONENT, "bonn:balloon")
    check_dataset_reader(tum.COMPONENT, "tum:f3/wx")
    check_dataset_reader(dycheck.COMPONENT, "dycheck:apple")
    check_dataset_reader(droidw.COMPONENT, "droidw:downtown1")
    check_dataset_reader(droidw.COMPONENT, "youtube:giraffe")
