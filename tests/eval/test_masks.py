"""Motion-mask scores against brute force."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from droidw.errors import InputError
from droidw.eval.mask_cells import check_shape, resize_mask
from droidw.eval.mask_files import find_masks, read_mask
from droidw.eval.masks import score_folder, score_masks


def brute_force(u: np.ndarray, mask: np.ndarray) -> tuple[float, float, float]:
    """AUC over all pairs, best F1 and best IoU over all thresholds."""
    up, down = u[mask], u[~mask]
    wins = (up[:, None] > down[None]).sum() + 0.5 * (up[:, None] == down[None]).sum()
    f1, iou = 0.0, 0.0
    for threshold in np.unique(u):
        said = u >= threshold
        both = (said & mask).sum()
        f1 = max(f1, 2 * both / (said.sum() + mask.sum()))
        iou = max(iou, both / (said | mask).sum())
    return wins / (len(up) * len(down)), f1, iou


@pytest.mark.parametrize("levels", [2, 5, 65536])
@pytest.mark.parametrize("seed", [0, 1])
def test_exact_with_and_without_ties(levels: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    maps = [rng.integers(0, levels, (9, 12)).astype(np.uint16) for _ in range(3)]
    masks = [(m + rng.normal(0, levels / 3, m.shape)) > levels / 2 for m in maps]
    found = score_masks(maps, masks)
    auc, f1, iou = brute_force(
        np.concatenate([m.ravel() for m in maps]), np.concatenate([m.ravel() for m in masks])
    )
    assert found.auc == pytest.approx(auc, rel=1e-12)
    assert found.f1 == pytest.approx(f1, rel=1e-12)
    assert found.iou == pytest.approx(iou, rel=1e-12)
    said = np.concatenate([m.ravel() for m in maps]) >= found.threshold
    truth = np.concatenate([m.ravel() for m in masks])
    assert (said & truth).sum() / (said | truth).sum() == pytest.approx(found.iou)


def test_by_hand() -> None:
    u = np.array([[0.1, 0.4], [0.35, 0.8]])
    found = score_masks([u], [np.array([[False, False], [True, True]])])
    assert found.auc == 0.75
    assert found.f1 == pytest.approx(0.8)
    assert found.iou == pytest.approx(2 / 3)
    assert found.threshold == 0.35
    assert found.moving == 0.5


def test_constant_uncertainty_is_chance() -> None:
    mask = np.arange(20).reshape(4, 5) < 5
    assert score_masks([np.ones((4, 5))], [mask]).auc == 0.5


def test_one_kind_of_cell_only() -> None:
    u = np.random.default_rng(0).uniform(size=(3, 3))
    nothing = score_masks([u], [np.zeros((3, 3), bool)])
    assert nothing.auc is nothing.f1 is nothing.iou is nothing.threshold is None
    assert "no mask marks anything" in nothing.notes[0]
    everything = score_masks([u], [np.ones((3, 3), bool)])
    assert everything.auc is None and everything.f1 == 1.0


def test_cells_that_are_not_finite_are_left_out() -> None:
    u = np.array([[np.nan, 0.2], [0.9, np.inf]])
    found = score_masks([u], [np.array([[True, False], [True, False]])])
    assert found.auc == 1.0 and found.cells == 2
    assert found.notes == ("2 of 4 cells are not finite and left out",)
    with pytest.raises(InputError, match="no cell has a finite"):
        score_masks([np.full((2, 2), np.nan)], [np.ones((2, 2), bool)])


def test_shapes_are_checked() -> None:
    with pytest.raises(InputError, match="map 0"):
        score_masks([np.ones((2, 2))], [np.ones((2, 3), bool)])
    with pytest.raises(InputError, match="0 uncertainty maps"):
        score_masks([], [])


def test_a_mask_is_reduced_by_area() -> None:
    mask = np.zeros((16, 24), bool)
    mask[:8, :8] = True
    mask[8:, 16:20] = True
    mask[8:16, 8:11] = True
    assert resize_mask(mask, (2, 3)).tolist() == [[True, False, False], [False, False, True]]
    assert resize_mask(mask, mask.shape).tolist() == mask.tolist()
    wider = resize_mask(np.array([[True, False]]), (2, 4))
    assert wider.tolist() == [[True, True, False, False]] * 2


def folder(tmp_path: Path, names: list[str], listed: bool) -> Path:
    """A sequence whose masks mark the left half, and run maps that find it."""
    for sub in ("rgb", "mask", "uncertainty"):
        (tmp_path / sub).mkdir(parents=True)
    for number, name in enumerate(names):
        mask = np.zeros((48, 64), np.uint8)
        mask[:, : 32 if number else 16] = 255
        cv2.imwrite(str(tmp_path / "mask" / f"{name}.png"), mask)
        (tmp_path / "rgb" / f"{name}.jpg").touch()
        u = np.full((6, 8), 1000, np.uint16)
        u[:, : 4 if number else 2] = 40000
        cv2.imwrite(str(tmp_path / "uncertainty" / f"{number:06d}.png"), u)
    if listed:
        rows = "".join(f"{i / 30:.6f} rgb/{name}.jpg\n" for i, name in enumerate(names))
        (tmp_path / "rgb.txt").write_text("# timestamp filename\n" + rows)
    return tmp_path


@pytest.mark.parametrize("listed", [True, False])
def test_folders_are_paired_by_frame(tmp_path: Path, listed: bool) -> None:
    root = folder(tmp_path, ["1311.10", "1311.13", "1311.17"], listed)
    (root / "mask" / "1311.13.png").unlink()
    found = score_folder(root / "uncertainty", root / "mask")
    assert (found.frames, found.without_mask) == (2, 1)
    assert (found.auc, found.f1, found.iou) == (1.0, 1.0, 1.0)
    assert find_masks(root / "mask").keys() == {0, 2}
    assert found.moving == pytest.approx((0.25 + 0.5) / 2)


def test_masks_alone_are_counted(tmp_path: Path) -> None:
    root = folder(tmp_path, ["a", "b"], listed=False)
    for path in (root / "rgb").iterdir():
        path.unlink()
    assert [find_masks(root / "mask")[i].name for i in (0, 1)] == ["a.png", "b.png"]


def test_another_count_is_refused(tmp_path: Path) -> None:
    root = folder(tmp_path, ["a", "b", "c"], listed=True)
    for number, path in enumerate(sorted((root / "mask").iterdir())):
        path.rename(root / "mask" / f"m{number}.png")
    assert score_folder(root / "uncertainty", root / "mask").frames == 3  # by order
    (root / "mask" / "m1.png").unlink()
    with pytest.raises(InputError, match="its 2 masks cannot be laid on 3 pictures"):
        score_folder(root / "uncertainty", root / "mask")
    # Nothing says how many pictures there are, but the maps tell that there were more.
    (root / "rgb.txt").unlink()
    for path in (root / "rgb").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="the uncertainty maps go up to picture 2"):
        score_folder(root / "uncertainty", root / "mask")


def test_another_shape_is_refused(tmp_path: Path) -> None:
    root = folder(tmp_path, ["a", "b"], listed=True)
    for path in (root / "uncertainty").iterdir():
        cv2.imwrite(str(path), np.zeros((8, 6), np.uint16))
    with pytest.raises(InputError, match=r"a\.png: a mask of 64x48 pixels .* maps of 6x8 cells"):
        score_folder(root / "uncertainty", root / "mask")
    # A run may work on another shape than the footage has: axes are then stretched alike.
    cv2.imwrite(str(root / "rgb" / "a.jpg"), np.zeros((48, 64), np.uint8))
    assert score_folder(root / "uncertainty", root / "mask").frames == 2


@pytest.mark.parametrize(
    ("shape", "fits"), [((45, 80), True), ((48, 64), False), ((60, 80), False)]
)
def test_cropping_to_whole_cells_is_no_other_shape(shape, fits) -> None:
    """16:9 pictures 80 pixels wide are worked on as 80x40."""
    u = np.zeros((5, 10), np.uint16)
    for shown in ([], [(80, 40), (80, 45)]):
        if fits:
            check_shape(Path("m.png"), np.zeros(shape, bool), u, shown)
            continue
        with pytest.raises(InputError, match="has another shape"):
            check_shape(Path("m.png"), np.zeros(shape, bool), u, shown)


def test_masks_are_found_by_time(tmp_path: Path) -> None:
    root = folder(tmp_path, ["a", "b", "c", "d"], listed=True)
    for number, path in enumerate(sorted((root / "mask").iterdir())):
        path.rename(root / "mask" / f"{number / 30 + 0.004:.6f}.png")
    (root / "mask" / f"{1 / 30 + 0.004:.6f}.png").unlink()
    found = score_folder(root / "uncertainty", root / "mask")
    assert (found.frames, found.without_mask, found.auc) == (3, 1, 1.0)
    assert "3 of 4 uncertainty maps have a mask" in found.notes[0]


def test_masks_elsewhere_go_by_the_names_of_the_source(tmp_path: Path) -> None:
    root = folder(tmp_path / "clip", ["p", "q", "r"], listed=True)
    (root / "mask" / "p.png").unlink()
    masks = (root / "mask").rename(tmp_path / "elsewhere")
    assert find_masks(masks, root).keys() == {1, 2}
    # Without the source, nothing says that the first one is missing.
    assert find_masks(masks).keys() == {0, 1}


NUMBERS = [str(number) for number in range(1, 13)]


def _one_is_different(root: Path, names: list[str]) -> None:
    """Mask and map of the last picture mark another part than those of all others."""
    for number, name in enumerate(names):
        share = 6 if number == len(names) - 1 else 2
        mask, u = np.zeros((48, 64), np.uint8), np.full((6, 8), 1000, np.uint16)
        mask[:, : 8 * share], u[:, :share] = 255, 40000
        cv2.imwrite(str(root / "mask" / f"{name}.png"), mask)
        cv2.imwrite(str(root / "uncertainty" / f"{number:06d}.png"), u)


def test_numbers_without_zeros_go_as_pictures_do(tmp_path: Path) -> None:
    root = folder(tmp_path, NUMBERS, listed=False)
    _one_is_different(root, NUMBERS)
    assert score_folder(root / "uncertainty", root / "mask").auc == 1.0
    for path in (root / "mask").iterdir():  # by order
        path.rename(path.with_name(f"m{path.name}"))
    assert score_folder(root / "uncertainty", root / "mask").auc == 1.0


@pytest.mark.parametrize("place", ["rgb", "images", "."])
@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_pictures_are_listed_as_readers_do(tmp_path: Path, place: str, suffix: str) -> None:
    root = folder(tmp_path, ["a b", "c", "d"], listed=False)
    (root / place).mkdir(exist_ok=True)
    for path in list((root / "rgb").iterdir()):
        path.rename(root / place / f"{path.stem}.{suffix}")
    (root / "mask" / "a b.png").unlink()
    assert find_masks(root / "mask").keys() == {1, 2}
    if place == ".":  # a picture that only lies there is no footage
        (root / f"c.{suffix}").unlink()
        (root / f"d.{suffix}").unlink()
        assert find_masks(root / "mask").keys() == {0, 1}


def test_masks_called_as_footage_are_none(tmp_path: Path) -> None:
    masks = folder(tmp_path, ["a", "b"], listed=False) / "mask"
    for path in (tmp_path / "rgb").iterdir():
        path.unlink()
    (masks / "a.png").unlink()
    masks = masks.rename(tmp_path / "images")
    with pytest.raises(InputError, match="the uncertainty maps go up to picture 1"):
        score_folder(tmp_path / "uncertainty", masks)


@pytest.mark.parametrize(
    "listing",
    [
        "\ufeff# timestamp filename\n0.0 rgb/p.jpg\n0.1 rgb/q.jpg\n0.2 rgb/r.jpg\n",
        "0.0,rgb/p.jpg\n0.1, rgb/q.jpg\n0.2,rgb/r.jpg\n",
        "0.0 rgb/p.jpg\n0.1 rgb/q.jpg\n\n0.2 rgb/r.jpg  # the last\n",
    ],
    ids=["mark", "commas", "remark"],
)
def test_any_listing_that_runs_is_one_to_score(tmp_path: Path, listing: str) -> None:
    root = folder(tmp_path, ["p", "q", "r"], listed=False)
    (root / "rgb.txt").write_text(listing, encoding="utf-8")
    (root / "mask" / "p.png").unlink()
    assert find_masks(root / "mask").keys() == {1, 2}


@pytest.mark.parametrize("value", [1, 3, 200, 255, 30000, 65535])
def test_values_of_16_bits_are_numbers_of_objects(tmp_path: Path, value: int) -> None:
    picture = np.zeros((4, 6), np.uint16)
    picture[:, :3] = value
    cv2.imwrite(str(tmp_path / "m.png"), picture)
    assert np.array_equal(read_mask(tmp_path / "m.png"), picture > 0)


def test_masks_by_number_where_some_are_missing(tmp_path: Path) -> None:
    for number in (3, 7, 9):
        cv2.imwrite(str(tmp_path / f"{number:06d}.png"), np.zeros((4, 4), np.uint8))
    assert find_masks(tmp_path).keys() == {3, 7, 9}
    (tmp_path / "000007.png").unlink()
    (tmp_path / "000003.png").rename(tmp_path / "000008.png")
    assert find_masks(tmp_path).keys() == {0, 1}  # 8 and 9: counted from somewhere, by order


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    root = folder(tmp_path, ["a"], listed=True)
    with pytest.raises(InputError, match="no such folder"):
        score_folder(root / "uncertainty", root / "nothing")
    (root / "uncertainty" / "000000.png").rename(root / "uncertainty" / "000009.png")
    with pytest.raises(InputError, match="no mask belongs to any of the 1"):
        score_folder(root / "uncertainty", root / "mask")
    (root / "uncertainty" / "000000.png").write_text("no picture")
    with pytest.raises(InputError, match="cannot be read as a picture"):
        score_folder(root / "uncertainty", root / "mask")
    cv2.imwrite(str(root / "uncertainty" / "000000.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="colour"):
        score_folder(root / "uncertainty", root / "mask")


@pytest.mark.parametrize(
    ("picture", "moves"),
    [
        ([0, 1, 0, 1], [0, 1, 0, 1]),
        ([0, 1, 2, 3], [0, 1, 1, 1]),  # numbers of objects
        ([0, 100, 128, 255], [0, 0, 1, 1]),  # soft edges
        ([0, 0, 0, 0], [0, 0, 0, 0]),
        ([[0, 0, 0], [0, 0, 128], [0, 128, 0], [64, 0, 0]], [0, 1, 1, 1]),  # of DAVIS
        ([[0, 0, 0], [3, 0, 1], [0, 128, 0], [255, 255, 255]], [0, 0, 1, 1]),
        ([[0, 0, 0], [3, 0, 1], [60, 60, 60], [90, 100, 90]], [0, 0, 0, 0]),  # one odd pixel
        ([0, 3, 60, 100], [0, 0, 0, 0]),  # soft, and nothing is left of what moved
    ],
)
def test_what_moves_in_masks_of_all_kinds(tmp_path: Path, picture, moves) -> None:
    cv2.imwrite(str(tmp_path / "m.png"), np.array([picture], np.uint8))
    assert read_mask(tmp_path / "m.png").tolist() == [[bool(one) for one in moves]]


def test_a_dark_mask_among_soft_ones_holds_no_numbers(tmp_path: Path) -> None:
    root = folder(tmp_path, ["a", "b"], listed=True)
    soft = np.full((48, 64), 12, np.uint8)  # probabilities: hardly anywhere is it surely nothing
    cv2.imwrite(str(root / "mask" / "a.png"), soft)
    soft[:, :32] = 240
    cv2.imwrite(str(root / "mask" / "b.png"), soft)
    found = score_folder(root / "uncertainty", root / "mask")
    assert found.moving == 0.25  # half of the second picture
    for name in "ab":  # all of them dark: numbers of objects
        cv2.imwrite(str(root / "mask" / f"{name}.png"), np.where(soft > 127, 3, 0).astype(np.uint8))
    assert score_folder(root / "uncertainty", root / "mask").moving == 0.5


def test_the_black_of_a_jpeg_is_not_clean(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(0, 6, (32, 32, 3)).clip(0, 30).astype(np.uint8)
    for right in (0, 255):
        noise[:, 16:] = right
        cv2.imwrite(str(tmp_path / "m.jpg"), noise)
        mask = read_mask(tmp_path / "m.jpg")
        assert not mask[:, :15].any() and mask[:, 17:].all() == (right > 0)


def test_the_first_maps_may_be_left_out(tmp_path: Path) -> None:
    root = folder(tmp_path, ["a", "b", "c"], listed=True)
    # The first map marks the wrong half.
    wrong = np.full((6, 8), 1000, np.uint16)
    wrong[:, 4:] = 50000
    cv2.imwrite(str(root / "uncertainty" / "000000.png"), wrong)
    whole = score_folder(root / "uncertainty", root / "mask")
    rest = score_folder(root / "uncertainty", root / "mask", after=1)
    assert whole.auc is not None and whole.auc < 0.9
    assert (rest.auc, rest.frames) == (1.0, 2)
    with pytest.raises(InputError, match="of 3 uncertainty maps, none is left after the first 3"):
        score_folder(root / "uncertainty", root / "mask", after=3)


def test_masks_that_droidw_wrote_go_by_number(tmp_path):
    source, masks = tmp_path / "clip", tmp_path / "masks"
    for folder in (source, masks):
        folder.mkdir()
    for k in range(4):  # pictures that are counted from 1
        cv2.imwrite(str(source / f"{k + 1:06d}.png"), np.zeros((8, 8), np.uint8))
    for k in (0, 2):
        cv2.imwrite(str(masks / f"{k:06d}.png"), np.zeros((8, 8), np.uint8))
    assert find_masks(masks, source).keys() == {1}  # by name
    (masks / "scale.json").write_text('{"named": "index"}')
    assert find_masks(masks, source).keys() == {0, 2}
