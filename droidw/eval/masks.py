"""How well uncertainty finds what moves: AUC, F1 and IoU against binary masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from droidw.errors import InputError
from droidw.eval.mask_cells import Cells
from droidw.eval.mask_files import (
    find_masks,
    frames_beside,
    objects_by_number,
    pictures_in,
    read_mask,
    read_uncertainty,
)

__all__ = ["MaskScore", "score_folder", "score_masks"]


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


def score_folder(
    uncertainty: Path, masks: Path, after: int = 0, source: Path | None = None
) -> MaskScore:
    """Score the maps `uncertainty/NNNNNN.png` (named by frame index) against a folder of masks.

    A mask of any size goes the way that the pictures went (`Cells`); one of another shape is
    refused. Which mask belongs to which picture: `find_masks`.

    Args:
        uncertainty: folder of maps. masks: folder of masks, see `find_masks`.
        after: the first maps, so many, are left out: a model that learns online knows nothing yet.
        source: folder that the run was made from, for the names of its pictures.
    Raises:
        InputError: if a folder is missing, a file cannot be read, a mask has another shape than
            the pictures, no map has a mask, or none is left.
    """
    maps = {
        int(path.stem): path
        for path in pictures_in(uncertainty)
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
    known = find_masks(masks, source)
    pairs = [(maps[index], known[index]) for index in sorted(maps) if index in known]
    if max(maps) >= len(known) == max(known) + 1 and not frames_beside(masks, source):
        raise InputError(
            f"{masks}: its {len(known)} masks cannot be laid on the pictures: the uncertainty maps "
            f"go up to picture {max(maps)}, counted from 0",
            "give one mask per picture, in the order of the pictures",
        )
    if not pairs:
        raise InputError(
            f"{masks}: no mask belongs to any of the {len(maps)} uncertainty maps in {uncertainty}",
            "name each mask like its picture, or give one mask per picture, in their order",
        )
    cells = Cells(uncertainty, masks, source)
    numbered = objects_by_number(mask for _, mask in pairs)
    values: list[npt.NDArray[Any]] = []
    truth: list[npt.NDArray[np.bool_]] = []
    for map_path, mask_path in pairs:
        u, mask = read_uncertainty(map_path), read_mask(mask_path, numbered)
        values.append(u)
        truth.append(cells.lay(mask_path, mask, u))
    notes = []
    if len(pairs) < len(maps):
        notes.append(
            f"{len(pairs)} of {len(maps)} uncertainty maps have a mask in {masks}; the others are "
            "not scored"
        )
    result = score_masks(values, truth)
    return MaskScore(
        **{
            **result.__dict__,
            "without_mask": len(maps) - len(pairs),
            "notes": (*notes, *result.notes),
        }
    )
