"""Where much is hidden, frames between keyframes become keyframes, too."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

# Of 26 frames those with numbers 0, 12, 21 and 25 become keyframes by themselves.
SPARSE = (
    "motion_filter.threshold=0.8", "frontend.keyframe_threshold=0.2", "frontend.warmup=3",
    "backend.passes=[1, 1, 1, 1]",
)  # fmt: skip


@pytest.fixture
def masked(footage):
    """Footage, and masks of the left fifth of each picture."""
    clip = footage()
    masks = clip.folder.parent / "masks"
    masks.mkdir()
    for k in range(len(clip.times)):
        mask = np.zeros((120, 160), np.uint8)
        mask[:, :32] = 255
        cv2.imwrite(str(masks / f"{k:04d}.png"), mask)
    return clip.folder, masks


def keyframes(ran):
    """Numbers of the frames that are keyframes, and how many the manifest says there are."""
    assert ran.code == 0, ran.err
    times = np.loadtxt(ran.folder / "keyframes.tum", ndmin=2)[:, 0]
    return [round(30 * t) for t in times], ran.manifest["keyframes"]


def test_gaps_are_parted_where_much_is_hidden(go, masked):
    folder, masks = masked
    given = (folder, "--masks", masks, *SPARSE, "backend.restart_below=0")
    before, count = keyframes(go(*given, "backend.between=0", to="a"))
    assert count == len(before)
    ran = go(*given, to="b")
    after, count = keyframes(ran)
    assert count == len(after)
    assert after == sorted(after)
    assert after[::2] == before
    for one, new, other in zip(before[:-1], after[1::2], before[1:], strict=True):
        assert abs(new - (one + other) / 2) <= 1
    assert len(ran.poses) == 26
    read_again = go(*given, "backend.between=1", "filler.cache_mb=0", to="c")
    assert np.array_equal(read_again.poses, ran.poses)
    assert (
        f"{len(after) - len(before)} frames between {len(before)} keyframes"
        in (ran.folder / "log.txt").read_text()
    )


@pytest.mark.parametrize("hides", [True, False])
def test_and_nowhere_else(go, masked, hides):
    folder, masks = masked
    more = ("--masks", masks, "backend.between_hidden=0.3") if hides else ()
    before, _ = keyframes(go(folder, *more, *SPARSE, "backend.between=0", to="a"))
    after, _ = keyframes(go(folder, *more, *SPARSE, to="b"))
    assert after == before
