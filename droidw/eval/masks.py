"""How well uncertainty finds what moves: AUC, F1 and IoU against binary masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw.errors import InputError

__all__ = [
    "MaskScore",
    "find_masks",
    "read_mask",
    "read_uncertainty",
    "resize_mask",
    "score_folder",
    "score_masks",
]

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True)
class MaskScore:
    """Agreement of uncertainty with masks, all cells of all frames pooled.

    Attributes:
        frames: maps that had a mask; without_mask: maps that had none.
        cells: number of compared cells; moving: share of them that a mask marks.
        auc: area under the ROC curve: the chance that a moving cell has a larger uncertainty than
            a static one, ties counted half; None where all cells are of one kind.
        f1, iou: the best over all thresholds (both are best at the same one); None where no cell
            moves.
        threshold: cells with at least this uncertainty are called moving at that point.
        notes: sentences.
    """

    frames: int
    without_mask: int
    cells: int
    moving: float
    auc: float | None
    f1: float | None
    iou: float | None
    threshold: float | None
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able record."""
        return {
            "frames": self.frames,
            "without_mask": self.without_mask,
            "cells": self.cells,
            "moving": self.moving,
            "auc": self.auc,
            "f1": self.f1,
            "iou": self.iou,
            "threshold": self.threshold,
            "notes": list(self.notes),
        }


def score_masks(
    uncertainty: Sequence[npt.NDArray[Any]], masks: Sequence[npt.NDArray[np.bool_]]
) -> MaskScore:
    """Score uncertainty maps against masks of the same shapes, pooled over all of them.

    Exact: every distinct value is a threshold, and ties count half (the Mann-Whitney statistic).
    Cells whose uncertainty is not finite are left out and counted in the notes.

    Args:
        uncertainty: maps [h,w], larger means less static; one scale for all.
        masks: [h,w] bool, True where something moves.
    Raises:
        InputError: if there is nothing to compare or two shapes differ.
    """
    if not uncertainty or len(uncertainty) != len(masks):
        raise InputError(f"there are {len(uncertainty)} uncertainty maps and {len(masks)} masks")
    for number, (u, mask) in enumerate(zip(uncertainty, masks, strict=True)):
        if u.shape != mask.shape:
            raise InputError(f"map {number} is {u.shape} and its mask {mask.shape}")
    values = np.concatenate([np.asarray(u).reshape(-1) for u in uncertainty])
    labels = np.concatenate([np.asarray(m, dtype=bool).reshape(-1) for m in masks])
    notes: list[str] = []
    finite = np.isfinite(values)
    if not finite.all():
        notes.append(f"{int((~finite).sum())} of {len(values)} cells are not finite and left out")
        values, labels = values[finite], labels[finite]
    if not len(values):
        raise InputError("no cell has a finite uncertainty")
    levels, where = np.unique(values, return_inverse=True)
    count = len(levels)
    positive = np.bincount(where[labels], minlength=count).astype(np.float64)
    negative = np.bincount(where[~labels], minlength=count).astype(np.float64)
    P, N = float(positive.sum()), float(negative.sum())
    auc = f1 = iou = threshold = None
    if P and N:
        below = np.cumsum(negative) - negative
        auc = float(np.sum(positive * (below + 0.5 * negative)) / (P * N))
    if P:
        hits = np.cumsum(positive[::-1])[::-1]
        false = np.cumsum(negative[::-1])[::-1]
        overlap = hits / (P + false)
        best = int(np.argmax(overlap))
        iou = float(overlap[best])
        f1 = 2 * iou / (1 + iou)
        threshold = float(levels[best])
    if not P:
        notes.append("no mask marks anything: there is no AUC, F1 or IoU")
    elif not N:
        notes.append("the masks mark everything: there is no AUC")
    return MaskScore(
        frames=len(masks),
        without_mask=0,
        cells=len(values),
        moving=P / len(values),
        auc=auc,
        f1=f1,
        iou=iou,
        threshold=threshold,
        notes=tuple(notes),
    )


def score_folder(uncertainty: Path, masks: Path, after: int = 0) -> MaskScore:
    """Score the maps `uncertainty/NNNNNN.png` (named by frame index) against a folder of masks.

    Both are taken to show the same field of view; a mask is reduced to the size of its map.

    Args:
        uncertainty: folder of maps. masks: folder of masks, see `find_masks`.
        after: the first maps, so many, are left out: a model that learns online knows nothing yet.
    Raises:
        InputError: if a folder is missing, a file cannot be read, no map has a mask, or none is
            left.
    """
    maps = {
        int(path.stem): path
        for path in _pictures(uncertainty)
        if path.suffix.lower() == ".png" and path.stem.isdigit()
    }
    if not maps:
        raise InputError(
            f"{uncertainty}: holds no uncertainty maps", "expected 16-bit pictures NNNNNN.png"
        )
    if after >= len(maps):
        raise InputError(
            f"{uncertainty}: of {len(maps)} uncertainty maps, none is left after the first {after}",
            "leave fewer out: --masks-after N",
        )
    maps = {index: maps[index] for index in sorted(maps)[after:]}
    known = find_masks(masks)
    notes: list[str] = []
    pairs = [(maps[index], known[index]) for index in sorted(maps) if index in known]
    if max(maps) >= len(known) == max(known) + 1 and not _frame_names(masks.parent):
        raise InputError(
            f"{masks}: its {len(known)} masks cannot be laid on the pictures: the uncertainty maps "
            f"go up to picture {max(maps)}, counted from 0",
            "give one mask per picture, in the order of the pictures",
        )
    if not pairs:
        raise InputError(
            f"{masks}: no mask belongs to any of the {len(maps)} uncertainty maps in {uncertainty}"
        )
    values: list[npt.NDArray[Any]] = []
    truth: list[npt.NDArray[np.bool_]] = []
    for map_path, mask_path in pairs:
        u, mask = read_uncertainty(map_path), read_mask(mask_path)
        stretch = (mask.shape[1] / mask.shape[0]) / (u.shape[1] / u.shape[0])
        if not 0.95 < stretch < 1.05 and not notes:
            notes.append(
                f"the masks are {mask.shape[1]}x{mask.shape[0]} and the maps {u.shape[1]}x"
                f"{u.shape[0]}: of another shape, so they may not lie on each other"
            )
        values.append(u)
        truth.append(resize_mask(mask, (u.shape[0], u.shape[1])))
    result = score_masks(values, truth)
    return MaskScore(
        **{
            **result.__dict__,
            "without_mask": len(maps) - len(pairs),
            "notes": (*notes, *result.notes),
        }
    )


def find_masks(folder: Path) -> dict[int, Path]:
    """Masks by the index of their frame.

    Frames are those of `rgb.txt` beside the folder, or else of `rgb/` beside it, in order, and a
    mask has the name of its frame; without such names, masks are counted from 0.

    Raises:
        InputError: if the folder is missing or holds no pictures, or if names and count of the
            masks are both other than those of the pictures.
    """
    files = _pictures(folder)
    if not files:
        raise InputError(f"{folder}: holds no masks", "expected pictures, white where it moves")
    by_stem = {path.stem: path for path in files}
    frames = _frame_names(folder.parent)
    named = {index: by_stem[name] for index, name in enumerate(frames) if name in by_stem}
    if not named and frames and len(frames) != len(files):
        raise InputError(
            f"{folder}: its {len(files)} masks cannot be laid on {len(frames)} pictures: none has "
            "the name of a picture, and the count is another",
            "name each mask like its picture, or give one mask per picture",
        )
    return named or dict(enumerate(files))


def _frame_names(folder: Path) -> list[str]:
    listing = folder / "rgb.txt"
    if listing.is_file():
        lines = listing.read_text(encoding="utf-8", errors="replace").splitlines()
        rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
        return [Path(row[1]).stem for row in rows if len(row) > 1]
    return [path.stem for path in _pictures(folder / "rgb")] if (folder / "rgb").is_dir() else []


def _pictures(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder")
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in _PICTURES)


def read_mask(path: Path) -> npt.NDArray[np.bool_]:
    """A mask [H,W] bool from a picture: True where it is brighter than half.

    A picture with values 0 and 1 alone counts as 0 and 255.

    Raises:
        InputError: if the file is no picture.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise InputError(f"{path}: cannot be read as a picture")
    return np.asarray(picture > (0 if picture.max(initial=0) == 1 else 127))


def read_uncertainty(path: Path) -> npt.NDArray[np.uint16]:
    """A map [h,w] uint16 as it is stored; 8-bit pictures are read too.

    Raises:
        InputError: if the file is no grey picture.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"{path}: cannot be read as a picture")
    if picture.ndim != 2:
        raise InputError(f"{path}: is a colour picture", "uncertainty maps are grey, 16 bits")
    return np.asarray(picture).astype(np.uint16)


def resize_mask(mask: npt.NDArray[np.bool_], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Reduce a mask [H,W] to a grid [h,w]: True where at least half of a cell's area moves."""
    height, width = shape
    if mask.shape == shape:
        return np.array(mask, dtype=bool)
    if height <= mask.shape[0] and width <= mask.shape[1]:
        share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        # Half a cell may come out as 0.4999999.
        return np.asarray(share >= 0.5 - 1e-5)
    near = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(near > 0)
