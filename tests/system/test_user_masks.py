"""`--masks`: what is masked has no say in bundle adjustment and is not in the cloud."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from droidw.io.tum import read_tum

POSTER = slice(0, 70)
"""Columns of the picture over which a poster is pasted that slides with a motion of its own."""


@pytest.fixture
def postered(footage, rendered):
    """Footage whose left part does not move as the camera does, and masks of that part."""
    images, scene = rendered("handheld")
    clip = footage("handheld")
    poster = np.random.default_rng(5).integers(0, 255, (60, 35, 3), np.uint8)
    poster = cv2.resize(poster, (70, 120), interpolation=cv2.INTER_LINEAR)
    masks = clip.folder.parent / "masks"
    masks.mkdir()
    for k, image in enumerate(images):
        shown = image.copy()
        shown[:, POSTER] = np.roll(poster, 2 * k, axis=0)
        cv2.imwrite(str(clip.folder / "rgb" / f"{k:04d}.png"), shown[..., ::-1])
        mask = np.zeros((120, 160), np.uint8)
        mask[:, POSTER] = 255
        cv2.imwrite(str(masks / f"{k:04d}.png"), mask)
    return clip, masks, scene


def test_masks_take_the_poster_out(go, postered):
    clip, masks, scene = postered
    # Maps of weights are what the exporter draws from. Patches are closer and depths freer than by
    # default, which is made for pictures twice as large and clips ten times as long. A kernel that
    # gives up what is far off would leave the masks little of the poster to do.
    more = (
        "exporters.uncertainty={maps: true, video: false}",
        "correspondence.options.patch_stride=4",
        "weighting.damping_floor=1e-7",
        "solver.cauchy=0",
    )
    plain = go(clip.folder, *more, to="plain")
    masked = go(clip.folder, "--masks", masks, *more, to="masked")
    assert plain.code == masked.code == 0
    errors = [error(ran, scene) for ran in (plain, masked)]
    assert errors[1] < 0.6 * errors[0], errors
    dim = [cv2.imread(str(p), 0) for p in sorted((masked.folder / "masks").glob("*.png"))]
    assert dim and all((mask[:, :64] == 255).all() and (mask[:, 80:] == 0).all() for mask in dim)
    assert not any(cv2.imread(str(p), 0).any() for p in (plain.folder / "masks").glob("[0-9]*.png"))


def error(ran, scene):
    """Position error after alignment, as a share of the path."""
    from droidw.eval.metrics import score

    found = score(read_tum(ran.folder / "trajectory.tum"), scene.trajectory)
    return found.ate_percent


def test_masks_are_written_into_the_configuration(go, postered):
    clip, masks, _ = postered
    (masks / "0007.png").unlink()
    ran = go(clip.folder, f"input.masks={masks}", "input.max_frames=12")
    assert ran.code == 0
    assert f"masks: {masks}" in (ran.folder / "config.yaml").read_text()
    assert "1 of 12 pictures have no mask in" in ran.warnings


def test_masks_that_do_not_fit(go, postered, tmp_path):
    clip, masks, _ = postered
    for k, path in enumerate(sorted(masks.iterdir())):
        path.rename(masks / f"m{k}.png") if k > 1 else path.unlink()
    for more in ((), ("--max-frames", "8")):
        ran = go(clip.folder, "--masks", masks, *more)
        assert ran.code == 3
        assert "its 24 masks cannot be laid on 26 pictures" in ran.err
        assert not ran.folder.exists()
    other = tmp_path / "other"
    other.mkdir()
    for k in range(26):
        cv2.imwrite(str(other / f"{k:04d}.png"), np.zeros((90, 90), np.uint8))
    ran = go(clip.folder, "--masks", other)
    assert ran.code == 3
    assert "a mask of 90x90 pixels (picture 0000.png) does not fit pictures of 160x120" in ran.err
    ran = go(clip.folder, "--masks", tmp_path / "none")
    assert ran.code == 3 and "there is no such folder" in ran.err


def test_masks_that_hide_everything_are_named(go, postered):
    """Black is used: masks that are the other way about leave nothing to see."""
    clip, masks, _ = postered
    for path in masks.iterdir():
        cv2.imwrite(str(path), np.full((120, 160), 255, np.uint8))
    ran = go(clip.folder, "--masks", masks, "--max-frames", "6")
    assert ran.code == 4
    assert f"the masks in {masks} hide all of them" in ran.err and "texture" not in ran.err


def test_no_depth_is_confirmed_where_nothing_was_measured(go, postered):
    """Ignored cells keep the depth that they began with, and so do those of all neighbours."""
    clip, masks, _ = postered
    ran = go(clip.folder, "--masks", masks, "exporters.depth={}")
    assert ran.code == 0, ran.err
    maps = np.load(ran.folder / "depth" / "depth.npz")
    assert maps["valid"][:, :, 10:].mean() > 0.3
    assert not maps["valid"][:, :, :8].any()  # columns of the poster, 8 pixels each
    pictures = [cv2.imread(str(p), -1) for p in sorted((ran.folder / "depth").glob("0*.png"))]
    assert pictures and all((picture[:, :8] == 0).all() for picture in pictures)


def test_a_score_of_masks_that_were_given_says_so(go, postered):
    clip, masks, _ = postered
    masks.rename(clip.folder / "mask")
    more = ("observers.report={}", "exporters.uncertainty={maps: true, video: false}")
    alone = go(clip.folder, *more, to="alone")
    given = go(clip.folder, *more, "--masks", clip.folder / "mask", to="told")
    assert alone.code == given.code == 0
    for ran, known in ((alone, False), (given, True)):
        notes = json.loads((ran.folder / "metrics.json").read_text())["masks"]["notes"]
        assert any("was told what moves" in note for note in notes) == known
        assert ("told by input.masks" in (ran.folder / "report.html").read_text()) == known
