"""Tiny trees in the layouts in which the datasets are published."""

from __future__ import annotations

import struct

import cv2
import numpy as np

START = 1548266469.0


def picture(path, size=(64, 48), grey=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((*size[::-1], 3), grey % 256, np.uint8))


def rgbd(folder, count=6, size=(64, 48), depth=True, rate=30.0, truth_rate=100.0):
    """rgb.txt, depth.txt, groundtruth.txt; truth moves 1 m/s along x."""
    rows, maps = [], []
    for i in range(count):
        stamp = f"{START + i / rate:.5f}"
        picture(folder / "rgb" / f"{stamp}.png", size, 9 * i)
        rows.append(f"{stamp} rgb/{stamp}.png")
        maps.append(f"{float(stamp) + 0.004:.5f} depth/{stamp}.png")
        if depth:
            (folder / "depth").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / "depth" / f"{stamp}.png"), np.full((48, 64), 10000, np.uint16))
    (folder / "rgb.txt").write_text("# color images\n" + "\n".join(rows) + "\n")
    if depth:
        (folder / "depth.txt").write_text("# depth maps\n" + "\n".join(maps) + "\n")
    times = np.arange(0, count / rate + 0.02, 1 / truth_rate)
    lines = [f"{START + t:.5f} {t:.5f} 0 0 0 0 0 1" for t in times]
    (folder / "groundtruth.txt").write_text("# truth\n" + "\n".join(lines) + "\n")
    return folder


def images_bin(path, poses, points=3):
    """COLMAP's images.bin of {name: (wxyz, t)}, world to camera."""
    data = struct.pack("<Q", len(poses))
    for number, (name, (turn, move)) in enumerate(poses.items(), 1):
        data += struct.pack("<i7di", number, *turn, *move, 1) + name.encode() + b"\0"
        data += struct.pack("<Q", points) + b"\0" * (24 * points)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def dycheck(folder, numbers=(0, 1, 2, 4, 5), size=(72, 96), others=True):
    """dense/images with a moving camera 0 and two that stand, poses 2 m apart per number."""
    poses = {}
    for n in numbers:
        picture(folder / "dense" / "images" / f"0_{n:05d}.png", size, 9 * n)
        # camera centre at (2n, 0, 0), turned by 90 degrees about z: t = -R c
        poses[f"0_{n:05d}.png"] = ((0.5**0.5, 0, 0, 0.5**0.5), (0.0, -2.0 * n, 0.0))
    if others:
        for camera in (1, 2):
            picture(folder / "dense" / "images" / f"{camera}_00000.png", size, 200)
            poses[f"{camera}_00000.png"] = ((1, 0, 0, 0), (9, 9, 9))
    images_bin(folder / "dense" / "sparse" / "images.bin", poses)
    (folder / "depth" / "1x").mkdir(parents=True, exist_ok=True)
    for n in numbers:
        np.save(folder / "depth" / "1x" / f"0_{n:05d}.npy", np.full((96, 72, 1), 2.5, np.float32))
    return folder


def walk(folder, count=6, rate=10.0, truth="traj_gt.txt", offset=0.03, columns=8):
    """images_anonymized/TIME.jpg and a trajectory whose clock is off by 30 ms."""
    for i in range(count):
        picture(folder / "images_anonymized" / f"{START + i / rate:.6f}.jpg", grey=9 * i)
    if truth:
        tail = " 0 0 0 1" if columns == 8 else ""
        rows = [f"{START + i / rate + offset:.6f} {i} 0 0{tail}" for i in range(count)]
        (folder / truth).write_text("\n".join(rows) + "\n")
    return folder


def clip(folder, numbers=(0, 1, 2, 5)):
    """rgb/frame00000.png and so on."""
    for n in numbers:
        picture(folder / "rgb" / f"frame{n:05d}.{'png' if n % 2 else 'jpg'}", (128, 72), 9 * n)
    return folder


def kitti(root, name="05", count=6, size=(124, 37), baseline=0.06):
    """sequences/NAME and poses/NAME.txt; camera 0 moves 1 m per picture along z."""
    folder = root / "sequences" / name
    for i in range(count):
        picture(folder / "image_2" / f"{i:06d}.png", size, 9 * i)
    (folder / "times.txt").write_text("".join(f"{i * 0.1037:.6e}\n" for i in range(count)))
    zero = "70.7 0 60 0 0 70.7 18 0 0 0 1 0"
    two = f"70.7 0 60 {70.7 * baseline} 0 70.7 18 0 0 0 1 0"
    (folder / "calib.txt").write_text(f"P0: {zero}\nP1: {zero}\nP2: {two}\nP3: {two}\nTr: {zero}\n")
    (root / "poses").mkdir(parents=True, exist_ok=True)
    rows = [f"1 0 0 0 0 1 0 0 0 0 1 {i}" for i in range(count)]
    (root / "poses" / f"{name}.txt").write_text("\n".join(rows) + "\n")
    return folder


SENSOR = """# General sensor definitions.
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02,
         1.0, 0.0, 0.0, -0.06,
         0.0, 0.0, 1.0, 0.01,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def euroc(folder, count=6, size=(752, 480), start=1403636579763555584):
    """mav0 with the left camera at 20 Hz and the state of the body at 200 Hz, 1 m/s along x."""
    mav = folder / "mav0"
    rows = ["#timestamp [ns],filename"]
    for i in range(count):
        stamp = start + i * 50_000_000
        picture(mav / "cam0" / "data" / f"{stamp}.png", size, 9 * i)
        rows.append(f"{stamp},{stamp}.png")
    (mav / "cam0" / "data.csv").write_text("\r\n".join(rows) + "\r\n")
    (mav / "cam0" / "sensor.yaml").write_text(SENSOR)
    states = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], ..."]
    for k in range(10 * count):
        states.append(f"{start + k * 5_000_000},{k * 0.005},0,0,1,0,0,0,9,9,9")
    (mav / "state_groundtruth_estimate0").mkdir(parents=True)
    (mav / "state_groundtruth_estimate0" / "data.csv").write_text("\n".join(states) + "\n")
    return folder
