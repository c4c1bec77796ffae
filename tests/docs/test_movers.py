"""benchmarks/movers.py pastes what its masks show, and leaves the rest of the room alone."""

import cv2
import numpy as np


def test_rooms_are_covered_by_what_the_masks_show(tmp_path, monkeypatch, load_benchmark):
    movers = load_benchmark("movers")
    clip = tmp_path / "data" / "clip"
    for name in ("rgb", "mask"):
        (clip / name).mkdir(parents=True)
    for k in range(2):
        mask = np.zeros((60, 120), np.uint8)
        mask[20:40, 50 + 5 * k : 70 + 5 * k] = 255
        cv2.imwrite(str(clip / "rgb" / f"{k}.png"), np.full((60, 120, 3), 7, np.uint8))
        cv2.imwrite(str(clip / "mask" / f"{k}.png"), mask)
    out = tmp_path / "out"
    monkeypatch.setattr(movers, "ROOMS", (("forward", 64, 48, 10.0),))

    movers.main([str(tmp_path / "data"), str(out), "--movers", "clip", "--frames", "5"])

    still, moving = out / "room0_forward", out / "room0_forward_moving"
    assert not (still / "mask").exists()
    for name in ("rgb.txt", "groundtruth.txt", "camera.txt"):
        assert (still / name).read_bytes() == (moving / name).read_bytes()
    masks = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in sorted((moving / "mask").iterdir())]
    assert len(masks) == 5
    assert (masks[0] == masks[2]).all() and not (masks[0] == masks[1]).all()
    for k, mask in enumerate(masks):
        before, after = (cv2.imread(str(f / "rgb" / f"{k:06d}.png")) for f in (still, moving))
        inside = cv2.erode(mask, np.ones((5, 5), np.uint8)) > 0
        outside = cv2.dilate(mask, np.ones((5, 5), np.uint8)) == 0
        assert inside.any() and (after[inside] == 7).all()
        assert (after[outside] == before[outside]).all()
