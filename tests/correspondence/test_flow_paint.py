"""What one picture hides, or ends before, is painted over with what the other one shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw_plugins.correspondence._flow_mask import painted

HEIGHT, WIDTH = 160, 208
GRID = Grid.of(HEIGHT, WIDTH, 8, 3.5)
SHIFT, OTHER = -6, 10  # pixels that the scene and what moves before it go to the right
PATCH = slice(48, 112), slice(64, 144)  # of the first picture


def test_where_one_hides_the_other_is_shown():
    one, other = np.full((1, 4), 10, np.uint8), np.full((1, 4), 20, np.uint8)
    masks = np.array([[0, 1, 0, 1]], bool), np.array([[0, 0, 1, 1]], bool)
    first, second = painted(one, other, masks)
    assert first.tolist() == [[10, 20, 10, 10]]
    assert second.tolist() == [[20, 20, 10, 10]]


def waves(seed):
    """[H,W] grey levels of smooth noise."""
    rng = np.random.default_rng(seed)
    coarse = torch.from_numpy(rng.random((1, 1, HEIGHT // 4, WIDTH // 4)))
    fine = torch.nn.functional.interpolate(coarse, (HEIGHT, WIDTH), mode="bicubic")[0, 0]
    return (255 * fine.clamp(0, 1)).numpy()


def hidden(moved):
    """[H,W] where the patch is once it has gone so far."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[PATCH] = True
    return np.roll(mask, moved, axis=1)


@pytest.fixture
def pair(frame):
    """`pair(patch)`: a faint scene and what goes another way before it; None: nothing does."""

    def call(patch):
        scene = 128 + 0.15 * (waves(2) - 128)
        pictures = [scene, np.roll(scene, SHIFT, axis=1)]
        if patch is not None:
            pictures = [
                np.where(hidden(moved), np.roll(patch, moved, axis=1), picture)
                for moved, picture in zip((0, OTHER), pictures, strict=True)
            ]
        return [frame(k, picture.round()) for k, picture in enumerate(pictures)]

    return call


GATES = torch.stack([1.0 - 0.9 * GRID.covered(torch.from_numpy(hidden(m))) for m in (0, OTHER)])


@pytest.fixture
def measured(operator, question):
    """`measured(frames, off, purpose, informed, **options)`: displacements, px, and confidence.

    Predicted is how the scene moves, and `off` px more, to the right.
    """

    def call(frames, off=0.0, purpose="global", informed=True, gates=GATES, **options):
        part = operator(**options)
        asked = question(part, frames)
        there = asked.coords + torch.tensor([(SHIFT + off) / 8, 0.0])
        asked = replace(
            asked, coords=there, informed=informed, gates=lambda nodes: gates[list(nodes)]
        )
        found = part.session(purpose).update(asked)
        return 8 * (found.target[0] - asked.coords[0]) + torch.tensor([SHIFT + off, 0.0]), (
            found.confidence[0, ..., :2].mean(-1)
        )

    return call


def beside(reach):
    """Open cells [h,w] up to so many from a closed one of either picture, inside of both."""
    closed = (GATES < 0.5).any(0)[None].float()
    near = torch.nn.functional.max_pool2d(closed, 2 * reach + 1, 1, reach)[0] > 0
    near[:, :2] = near[:, -2:] = False
    return near & (closed[0] == 0)


def error(found, cells):
    """Distance from how the scene moves, px: mean over cells, by confidence."""
    moved, sure = found
    off = (moved - torch.tensor([float(SHIFT), 0.0])).norm(dim=-1)
    assert float(sure[cells].sum()) > 0.2
    return float((off * sure)[cells].sum() / sure[cells].sum())


def test_nothing_is_followed_beside_what_moves(pair, measured):
    frames, cells = pair(waves(3)), beside(2)
    assert error(measured(frames), cells) < 0.1
    assert error(measured(frames), cells) < 0.5 * error(measured(frames, paint=False), cells)


def test_what_moves_makes_no_difference_to_what_it_leaves(pair, measured):
    def apart(**options):
        (moved, sure), (still, surely) = (measured(f, **options) for f in both)
        known = beside(2) & (sure > 0.05) & (surely > 0.05)
        assert known.sum() > 40
        return (moved - still).norm(dim=-1)[known].quantile(0.9)

    both = pair(waves(3)), pair(None)
    assert float(apart()) < 0.1
    assert apart() < 0.5 * apart(paint=False)


def test_a_wrong_prediction_is_not_confirmed(pair, measured):
    frames = pair(waves(3))
    for cells, kept in ((beside(30) & ~beside(2), 0.05), (beside(1), 0.5)):
        (right, sure), (wrong, _) = measured(frames), measured(frames, off=1.0)
        moved = (wrong - right)[..., 0][cells & (sure > 0.05)]
        assert abs(float(moved.median())) < kept  # of the pixel by which it was off


def test_what_is_closed_is_measured_as_it_moves(pair, measured):
    moved, sure = measured(pair(waves(3)))
    inside = slice(8, 12), slice(10, 16)
    off = (moved[inside] - torch.tensor([float(OTHER), 0.0])).norm(dim=-1)
    assert float(off[sure[inside] > 0.02].median()) < 0.5
    assert float((sure[inside] > 0.02).float().mean()) > 0.4


def test_what_a_user_masks_is_painted_over_too(pair, measured):
    frames = pair(waves(3))
    masked = [
        replace(f, mask=torch.from_numpy(hidden(m)))
        for f, m in zip(frames, (0, OTHER), strict=True)
    ]
    assert error(measured(masked), beside(2)) < 0.1


@pytest.mark.parametrize(
    ("purpose", "informed"), [("window", True), ("global", False), ("fill", True)]
)
def test_elsewhere_nothing_is(pair, measured, purpose, informed):
    frames = pair(waves(3))
    both = [measured(frames, purpose=purpose, informed=informed, paint=p) for p in (True, False)]
    assert all(torch.equal(*parts) for parts in zip(*both, strict=True))


@pytest.mark.parametrize("off", [0.0, 0.3])
def test_matches_fall_less_short_at_the_border(frame, measured, off):
    wide = np.concatenate([waves(2), waves(4)], axis=1)
    frames = [frame(k, wide[:, at : at + WIDTH].round()) for k, at in enumerate((100, 100 - SHIFT))]
    outermost = torch.zeros(GRID.height, GRID.width, dtype=torch.bool)
    outermost[1:-1, 1] = True  # which go to where the second picture ends
    open_all = torch.ones_like(GATES)
    known, short = (
        error(measured(frames, off, gates=open_all, paint=paint), outermost)
        for paint in (True, False)
    )
    assert known < 0.5 * short
