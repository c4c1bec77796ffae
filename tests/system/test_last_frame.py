"""The last frame is a keyframe: none lies beyond all keyframes, where it is seen from one side."""

from __future__ import annotations

import numpy as np
import pytest

from droidw.geometry.align import umeyama
from droidw.io.tum import read_tum

# Of 26 frames those with these numbers become keyframes by themselves.
SPARSE = ("motion_filter.threshold=0.8", "frontend.keyframe_threshold=0.2")
KEYFRAMES = (0, 12, 21)


def ends(ran):
    """Times of the last frame and of the last keyframe."""
    assert ran.code == 0, ran.err
    return [np.loadtxt(ran.folder / name)[-1, 0] for name in ("trajectory.tum", "keyframes.tum")]


def test_the_last_frame_becomes_a_keyframe(go, footage, rendered):
    clip = footage()
    as_any_other = go(clip.folder, *SPARSE, "motion_filter.last_above=1", to="a")
    last, keyframe = ends(as_any_other)
    assert (last, keyframe) == pytest.approx((25 / 30, KEYFRAMES[-1] / 30), abs=1e-4)
    closed = go(clip.folder, *SPARSE, to="b")
    last, keyframe = ends(closed)
    assert keyframe == last
    assert closed.manifest["keyframes"] == as_any_other.manifest["keyframes"] + 1
    assert closed.manifest["frames"] == 26

    scene = rendered("handheld")[1]
    true = np.stack([scene.T_wc(k)[:3] for k in range(26)])
    found = read_tum(closed.folder / "trajectory.tum").T_wc[:, :3]
    off = np.linalg.norm(umeyama(found, true).apply(found) - true, axis=1)
    assert off[-1] < 3 * np.median(off)


def test_a_camera_that_came_to_rest_needs_none(go, footage):
    clip = footage()
    pictures = sorted((clip.folder / "rgb").iterdir())
    for later in pictures[KEYFRAMES[-1] + 1 :]:
        later.write_bytes(pictures[KEYFRAMES[-1]].read_bytes())
    last, keyframe = ends(go(clip.folder, *SPARSE))
    assert (last, keyframe) == pytest.approx((25 / 30, KEYFRAMES[-1] / 30), abs=1e-4)


@pytest.mark.parametrize("shade", [0, 255])
def test_a_blank_picture_at_the_end_is_none(go, footage, shade):
    clip = footage(blank=[25], grey=shade)
    ran = go(clip.folder, *SPARSE, "motion_filter.last_above=0")
    last, keyframe = ends(ran)
    assert keyframe < last
