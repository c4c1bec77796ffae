"""What the user's mask covers is no part of the picture for `flow`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw_plugins.correspondence._flow_mask import bridge, outlined, without

HEIGHT, WIDTH = 160, 208
GRID = Grid.of(HEIGHT, WIDTH, 8, 3.5)


def hole(top=48, left=64, height=64, width=80):
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[top : top + height, left : left + width] = True
    return mask


def grain(seed, coarse=4):
    """[H,W] grey levels of smooth noise."""
    rng = np.random.default_rng(seed)
    cells = torch.from_numpy(rng.random((1, 1, HEIGHT // coarse, WIDTH // coarse)))
    full = torch.nn.functional.interpolate(cells, (HEIGHT, WIDTH), mode="bicubic")[0, 0]
    return (255 * full.clamp(0, 1)).numpy()


def test_a_ramp_is_bridged_and_the_rest_stays():
    ramp = np.broadcast_to(np.linspace(20, 220, WIDTH), (HEIGHT, WIDTH)).round().astype(np.uint8)
    mask = hole()
    seen = np.where(mask, 255, ramp).astype(np.uint8)
    seen[mask] = np.random.default_rng(0).integers(0, 256, mask.sum())
    bridged = without(seen, mask)
    far = ~hole(44, 60, 72, 88)
    assert np.array_equal(bridged[far], seen[far])
    apart = bridged[mask].astype(float) - ramp[mask]
    assert np.abs(apart).max() < 45  # the ramp spans 77 levels inside the mask, the noise 255
    steps = np.abs(np.diff(bridged.astype(float), axis=1))
    assert steps[mask[:, 1:]].max() < 12  # no edge to match: the noise steps by up to 255


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_masks_of_nothing_and_of_all(share):
    grey = grain(1).astype(np.uint8)
    bridged = without(grey, np.full(grey.shape, share > 0))
    assert bridged.dtype == np.uint8
    if share:
        assert np.ptp(bridged.astype(int)) == 0
    else:
        assert np.array_equal(bridged, grey)


@pytest.fixture
def pair(frame):
    """Two frames of a picture that moves by `shift` px, with a patch that moves by `other` px."""

    def call(shift, other, contrast=1.0):
        scene, patch = 128 + contrast * (grain(2) - 128), grain(3)
        masks = [hole(), hole(left=64 + other)]
        pictures = [scene, np.roll(scene, shift, axis=1)]
        patches = [patch, np.roll(patch, other, axis=1)]
        made = [np.where(m, p, s) for m, p, s in zip(masks, patches, pictures, strict=True)]
        made = [grey.round() for grey in made]  # as a decoder gives them
        return [frame(n, grey, m) for n, (grey, m) in enumerate(zip(made, masks, strict=True))]

    return call


@pytest.fixture
def measured(operator, question):
    """Displacement [h,w,2] px and confidence [h,w,3] from the first to the second.

    With gates [2,h,w] of uncertainty besides what is measured once these are known.
    """

    def call(frames, gates=None, **options):
        part = operator(**options)
        blind = question(part, frames)
        asked = [blind]
        if gates is not None:
            unknown = torch.zeros_like(blind.valid)
            blind = replace(blind, valid=unknown)
            known = replace(blind, informed=True, gates=lambda nodes: gates[list(nodes)])
            asked = [blind, known]
        session = part.session("window")
        answers = [session.update(request) for request in asked]
        return [(8 * (a.target[0] - blind.coords[0]), a.confidence[0]) for a in answers]

    return call


def test_what_is_masked_does_not_pull_at_its_surroundings(pair, measured):
    frames = pair(shift=-6, other=10, contrast=0.1)
    ring = torch.zeros(GRID.height, GRID.width, dtype=torch.bool)
    ring[4:16, 5:21] = True
    ring[6:14, 8:20] = False  # where the patch is in either frame
    wrong = []
    for given in (frames, [replace(f, mask=None) for f in frames]):
        [(moved, confidence)] = measured(given)
        off = (moved - torch.tensor([-6.0, 0.0])).norm(dim=-1)
        trusted = confidence[..., :2].mean(-1)
        wrong.append(float((trusted * (off > 2))[ring].sum() / trusted[ring].sum()))
        if given is frames:
            inside = confidence[8:12, 10:16]  # covered in both
            assert float(inside[..., :2].max()) < 0.5 * float(confidence[2:4, 2:].max())
    assert wrong[0] < 0.5 * wrong[1]
    assert wrong[0] < 0.05


def test_motion_is_that_of_what_is_left(pair, operator):
    frames = pair(shift=0, other=12)

    def motion(given):
        part = operator()
        return part.motion(*(part.encode(f, GRID) for f in given)).flow

    assert motion(frames) < 0.3 * motion([replace(f, mask=None) for f in frames])


def closed():
    """Gates [2,h,w] that shut the cells of the patch of `pair(-6, 10)` in either frame."""
    gates = torch.ones(2, GRID.height, GRID.width)
    gates[0, 6:14, 8:18] = 0.1
    gates[1, 6:14, 9:20] = 0.1
    return gates


def beside(cells, reach):
    """The cells [h,w], and those up to `reach` cells around them."""
    wide = torch.nn.functional.max_pool2d(cells[None].float(), 2 * reach + 1, 1, reach)
    return wide[0] > 0


@pytest.mark.parametrize("by", ["mask", "uncertainty"])
def test_a_contour_of_what_moves_says_nothing_of_a_blank_wall_beside_it(pair, measured, by):
    frames = pair(shift=-6, other=10, contrast=0.0)
    plain = [replace(f, mask=None) for f in frames]
    asked = (frames,) if by == "mask" else (plain, closed())
    taken, left = measured(plain)[0][1], measured(*asked)[-1][1]
    kept = measured(*asked, reach=0)[-1][1]
    wall = torch.ones(GRID.height, GRID.width, dtype=torch.bool)
    wall[6:14, 8:18] = False  # where the patch is in the first
    assert float(taken[..., :2][wall].max()) > 0.5
    taken_whole = measured(*asked, outline=False)[-1][1]
    assert float(taken_whole[wall].abs().max()) < 1e-6
    # a contour that is found may be a pixel off at a corner
    assert float(left[wall].abs().max()) < (1e-6 if by == "mask" else 1e-3)
    if by == "uncertainty":
        assert float(kept[..., :2][wall].max()) > 0.5


def test_what_a_user_masks_stays_masked_where_uncertainty_closes_more(frame, operator):
    grey = grain(2)
    masked = operator().encode(frame(0, grey, hole()), GRID)
    plain = operator().encode(frame(0, grey), GRID)
    gate = np.ones((GRID.height, GRID.width), dtype=np.float32)
    gate[:, -6:] = 0.1
    both, alone = bridge(masked, gate, 0.5, 7), bridge(plain, gate, 0.5, 7)
    covered = GRID.covered(torch.from_numpy(hole())).numpy() == 1
    assert (both.power[covered] < 1e-3).all() and (alone.power[covered][..., 0] > 1).all()
    assert np.array_equal(both.power[:, :5], alone.power[:, :5])
    assert np.array_equal(both.power[:, -6:], masked.power[:, -6:])


@pytest.mark.parametrize("reach", [0, 7])
def test_what_uncertainty_rejects_does_not_pull_at_its_surroundings(pair, measured, reach):
    frames = [replace(f, mask=None) for f in pair(shift=-6, other=10, contrast=0.1)]
    (before, sure_before), (after, sure_after) = measured(frames, closed(), reach=reach)
    truth = torch.tensor([-6.0, 0.0])
    right = [
        float((c[..., :2].mean(-1) * ((m - truth).norm(dim=-1) < 1)).sum())
        for m, c in ((before, sure_before), (after, sure_after))
    ]
    assert right[1] > 1.1 * right[0]
    out = closed()[0] < 0.5
    sure, surer = sure_before[..., :2].sum(-1), sure_after[..., :2].sum(-1)
    # with a reach, cells beside what is closed lose what its contour lent them
    away = ~beside(out, 2) if reach else ~out
    assert bool((surer[away] >= sure[away] - 1e-6).all())
    assert torch.allclose(surer[out], 0.2 * sure[out])
    patch = (slice(8, 12), slice(10, 16))  # what moves is still measured as it moves
    assert torch.equal(after[patch], before[patch])
    assert float((after[patch] - torch.tensor([10.0, 0.0])).norm(dim=-1).median()) < 0.5


def test_open_gates_and_no_bridge_change_nothing(pair, measured):
    frames = [replace(f, mask=None) for f in pair(shift=-6, other=10, contrast=0.1)]
    [plain] = measured(frames)
    for gates, options in (
        (torch.ones(2, GRID.height, GRID.width), {}),
        (closed(), {"bridge": 0.0}),
    ):
        after = measured(frames, gates, **options)[1]
        assert torch.equal(after[0], plain[0])
        assert torch.equal(after[1], plain[1])


def disc(x=101.0, y=83.0, radius=37.0):
    """[H,W], True within a circle."""
    yy, xx = np.mgrid[:HEIGHT, :WIDTH]
    return np.hypot(xx - x, yy - y) < radius


def touched(mask):
    """[h,w], the cells that a mask [H,W] covers any pixel of."""
    return GRID.covered(torch.from_numpy(mask)).numpy() > 0


def whole(cells):
    """[H,W], all pixels of cells [h,w]."""
    return np.kron(cells, np.ones((8, 8), bool))


def overlap(one, other):
    """Intersection over union of two masks."""
    return (one & other).sum() / (one | other).sum()


def test_what_cells_cover_ends_at_the_contour_in_the_picture():
    thing = disc()
    grey = np.where(thing, 60 + 0.2 * grain(3), 150 + 0.2 * grain(4)).astype(np.uint8)
    cells = touched(thing)
    found = outlined(grey, cells)
    assert overlap(whole(cells), thing) < 0.85
    assert overlap(found, thing) > 0.97
    # nothing is moved by more than the cell around the border of the closed ones
    assert not (found & ~disc(radius=37 + 8 * 3)).any() and found[disc(radius=37 - 8 * 3)].all()


def test_closed_cells_without_an_inside_stay_as_they_are():
    cells = np.zeros((GRID.height, GRID.width), dtype=bool)
    cells[4, 5:9] = cells[11, 20] = True
    found = outlined(grain(5).astype(np.uint8), cells)
    assert found[32:40, 40:72].all() and found[88:96, 160:168].all()
    near = beside(torch.from_numpy(cells)[None], 1)[0].numpy()
    assert not found[whole(~near)].any()


@pytest.mark.parametrize("open_cells", [0, 1])
def test_where_nothing_outside_is_known_cells_cover_what_they_cover(open_cells):
    cells = np.ones((GRID.height, GRID.width), dtype=bool)
    cells.flat[:open_cells] = False
    found = outlined(grain(6).astype(np.uint8), cells)
    assert np.array_equal(found, whole(cells))


def test_the_bridge_reaches_to_the_contour_or_to_the_end_of_the_cells(frame, operator):
    thing = disc()
    grey = np.where(thing, 30.0, 120.0 + 0.3 * grain(7)).astype(np.float32)
    seen = operator(blur=0.0).encode(frame(0, grey), GRID)
    gate = np.where(touched(thing), 0.1, 1.0).astype(np.float32)
    changed = [bridge(seen, gate, 0.5, 7, outline=o).grey != seen.grey for o in (True, False)]
    ring = disc(radius=46) & ~disc(radius=41)  # beyond the margin about a contour
    share = [float(c[ring].mean()) for c in changed]
    assert share[0] < 0.1 and share[1] > 0.3
    assert all(c[disc(radius=30)].mean() > 0.95 for c in changed)
