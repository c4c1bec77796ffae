"""The factor graph: directed edges between keyframes, active or retired (REFERENCE 5.2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from droidw.geometry.transfer import on_device

__all__ = ["FactorGraph"]


def _padded(confidence: Tensor, channels: int) -> Tensor:
    """The same information with zeros as its last channels."""
    missing = channels - confidence.shape[-1]
    return torch.nn.functional.pad(confidence, (0, missing)) if missing > 0 else confidence


class FactorGraph:
    """Edges i -> j with their measured targets and confidences.

    An active edge is refined at every update; a retired one keeps its last measurement and
    still takes part in bundle adjustment. Order is that of insertion, so ages fall along it.

    Attributes:
        ids, ii, jj, age, active: one entry per edge. `ids` never repeat within a graph.
        target: [E,h,w,2], cells; rows in the order of the lists.
        confidence: [E,h,w,2] or, from the first answer with an off-diagonal on, [E,h,w,3]; see
            `EdgeUpdate`.
    """

    def __init__(self, height: int, width: int, device: torch.device | str = "cpu") -> None:
        self.ids: list[int] = []
        self.ii: list[int] = []
        self.jj: list[int] = []
        self.age: list[int] = []
        self.active: list[bool] = []
        self.target = torch.zeros(0, height, width, 2, device=device)
        self.confidence = torch.zeros(0, height, width, 2, device=device)
        self._next = 0

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """All edges, active and retired."""
        return list(zip(self.ii, self.jj, strict=True))

    def select(self, active: bool = True) -> list[int]:
        """Rows of the active (or the retired) edges."""
        return [row for row, is_active in enumerate(self.active) if is_active == active]

    def add(self, pairs: Iterable[tuple[int, int]]) -> list[int]:
        """Add edges that are not there yet, in either state, and return the new rows."""
        known = set(self.pairs)
        first = len(self)
        for i, j in pairs:
            if (i, j) in known or i == j:
                continue
            known.add((i, j))
            self.ids.append(self._next)
            self._next += 1
            self.ii.append(i)
            self.jj.append(j)
            self.age.append(0)
            self.active.append(True)
        new = len(self) - first
        if new:
            for name in ("target", "confidence"):
                held = getattr(self, name)
                setattr(self, name, torch.cat([held, held.new_zeros(new, *held.shape[1:])]))
        return list(range(first, len(self)))

    def record(self, rows: Sequence[int], target: Tensor, confidence: Tensor) -> None:
        """Keep what was measured of these edges; where channels are missing, they are 0."""
        at = on_device(rows, self.target.device)
        if confidence.shape[-1] > self.confidence.shape[-1]:
            self.confidence = _padded(self.confidence, confidence.shape[-1])
        self.target[at] = target
        self.confidence[at] = _padded(confidence, self.confidence.shape[-1])

    def retire(self, rows: Iterable[int]) -> list[int]:
        """Make edges inactive; returns their ids, whose correspondence state may be dropped."""
        gone = []
        for row in rows:
            if self.active[row]:
                self.active[row] = False
                gone.append(self.ids[row])
        return gone

    def oldest(self, keep: int) -> list[int]:
        """Rows of the active edges beyond the `keep` youngest, oldest first."""
        rows = sorted(self.select(), key=lambda row: (-self.age[row], row))
        return rows[: max(0, len(rows) - keep)]

    def oldest_as_published(self, room: int) -> list[int]:
        """Rows of as many active edges as there are beyond `room`, by the published rule.

        Meant are the oldest, and it is them where edges are stored in the order of their age. In
        general the rule compares an edge's place in storage with its rank (REFERENCE 5.2); it is
        used under `compat: [droid-w]` alone.
        """
        rows = self.select()
        by_age = sorted(range(len(rows)), key=lambda k: self.age[rows[k]])
        return [row for row, rank in zip(rows, by_age, strict=True) if rank >= room]

    def drop(self, rows: Sequence[int]) -> list[int]:
        """Delete edges altogether; returns their ids."""
        doomed = set(rows)
        if not doomed:
            return []
        gone = [self.ids[row] for row in sorted(doomed)]
        keep = [row for row in range(len(self)) if row not in doomed]
        self._keep(keep)
        return gone

    def drop_before(self, first: int) -> list[int]:
        """Delete retired edges that touch a keyframe before `first`; returns their ids."""
        return self.drop(
            [r for r in self.select(active=False) if min(self.ii[r], self.jj[r]) < first]
        )

    def remove_keyframe(self, index: int) -> list[int]:
        """Delete the edges of keyframe `index` and renumber later ones; returns deleted ids."""
        gone = self.drop([r for r in range(len(self)) if index in (self.ii[r], self.jj[r])])
        self.ii = [i - (i > index) for i in self.ii]
        self.jj = [j - (j > index) for j in self.jj]
        return gone

    def grow_older(self, rows: Iterable[int], by: int = 1) -> None:
        """Add `by` updates to the age of these edges; an age does not fall below zero."""
        for row in rows:
            self.age[row] = max(0, self.age[row] + by)

    def index(self, rows: Sequence[int]) -> tuple[Tensor, Tensor]:
        """(ii, jj) of these rows as int64 tensors."""
        device = self.target.device
        return (
            on_device([self.ii[r] for r in rows], device),
            on_device([self.jj[r] for r in rows], device),
        )

    def _keep(self, rows: list[int]) -> None:
        for name in ("ids", "ii", "jj", "age", "active"):
            values = getattr(self, name)
            setattr(self, name, [values[row] for row in rows])
        chosen = on_device(rows, self.target.device)
        self.target = self.target[chosen]
        self.confidence = self.confidence[chosen]
