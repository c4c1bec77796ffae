"""Keyframes from between the others, once poses and depths are known.

Where much of each picture is hidden, more pictures make up for it. While a camera is tracked they
would have to be told apart by less motion, and a path that begins with a short way has its scale
from that; once it is known, a frame between two keyframes is measured like any other.
"""

from __future__ import annotations

import logging
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Sequence
from itertools import islice, pairwise
from typing import TYPE_CHECKING

import torch

from droidw.slam.doubt import explained_around, explained_share
from droidw.slam.filler import Filler
from droidw.slam.locate import carry_depth

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.config.schema import DroidwConfig
    from droidw.graph.factors import FactorGraph
    from droidw.slam.motion_filter import Encoded
    from droidw.slam.optimise import Optimiser

__all__ = ["Between", "chosen", "inherited"]

Pair = tuple[int, int]

# A keyframe is loose if less than this share of what agrees all over agrees about it. Of those that
# sat where they should it was a half and more of that, of one that was off nothing at all.
_LOOSE = 1 / 3

_log = logging.getLogger(__name__)


def chosen(keyframes: Sequence[int], frames: Sequence[int], most: int) -> list[int]:
    """Frames between keyframes, in each gap the ones that part it most evenly.

    Args:
        keyframes: indices of their frames, ascending. frames: of all frames, ascending.
        most: how many of a gap at most.
    """
    found = []
    for one, other in pairwise(keyframes):
        inside = frames[bisect_right(frames, one) : bisect_left(frames, other)]
        count = min(most, len(inside))
        found += [inside[len(inside) * (2 * k + 1) // (2 * count)] for k in range(count)]
    return found


def inherited(edges: Sequence[Pair], old: Sequence[int], count: int) -> list[Pair]:
    """Edges of a graph into which keyframes came, both directions of each pair.

    One that came is linked to its neighbours, and shares the edges of the keyframe before it: if it
    is alone in its gap every second one, of two every third. So near and far edges stay in
    proportion. Chosen among all keyframes most would be near ones, which drown the far ones that
    hold a path together.

    Args:
        edges: between the keyframes of before, numbered among themselves.
        old: the numbers that these have now, ascending, from 0 on. count: of all keyframes.
    """
    pairs = {(old[i], old[j]) for i, j in edges if i < j}
    ends: dict[int, list[int]] = {k: [] for k in old}
    for i, j in sorted(pairs):
        ends[i].append(j)
        ends[j].append(i)
    turn = 0
    for before, after in pairwise([*old, count]):
        for new in range(before + 1, after):
            others = {new - 1, *sorted(ends[before])[turn % (after - before) :: after - before]}
            others |= {new + 1} if new + 1 < count else set()
            pairs |= {(min(new, other), max(new, other)) for other in others}
            turn += 1
    return [pair for i, j in sorted(pairs) for pair in ((i, j), (j, i))]


class Between:
    """Adds keyframes between those of a store, and takes them out again.

    Args:
        optimiser: of the run, whose store is added to.
        config: resolved configuration.
        indices: of all frames, ascending.
        encoded: indices -> these frames in turn, as keyframes are made of; some may be missing.
        insert: makes keyframes of frames, each with these fields of the store, at their places.
    Attributes:
        made: there were frames to add, and what was made of them was not taken out again.
    """

    def __init__(
        self,
        optimiser: Optimiser,
        config: DroidwConfig,
        indices: Sequence[int],
        encoded: Callable[[set[int]], Iterable[Encoded]],
        insert: Callable[[Sequence[tuple[Encoded, dict[str, Tensor]]]], None],
    ) -> None:
        self._optimiser = optimiser
        self._config = config
        self._indices = indices
        self._encoded = encoded
        self._insert = insert
        self._added: set[int] = set()
        self.made = False

    def add(self) -> None:
        """Make keyframes of frames between those there are, where poses are located from these."""
        if self.made:
            return
        infos = self._optimiser.store.infos
        before = len(infos)
        wanted = chosen([info.index for info in infos], self._indices, self._config.backend.between)
        if not wanted:
            return
        filler = Filler(self._optimiser, self._config)
        made: list[tuple[Encoded, dict[str, Tensor]]] = []
        pending = iter(self._encoded(set(wanted)))
        while batch := list(islice(pending, self._config.filler.batch)):
            for encoded, pose in zip(batch, filler.fill(batch), strict=True):
                made.append((encoded, self._known(filler, encoded.frame.time, pose)))
        if made:
            self.made = True
            self._insert(made)
            self._added.update(encoded.frame.index for encoded, _ in made)
            _log.info(
                "much is hidden: %d frames between %d keyframes become keyframes, too "
                "(backend.between=0 does not)",
                len(made),
                before,
            )

    def remove(self) -> None:
        """Take out what was added."""
        self._take_out(self._numbers())
        self.made = False

    def remove_loose(self, graph: FactorGraph, gates: Tensor) -> None:
        """Take out those about which next to nothing agrees: poses and depths came loose.

        Args:
            graph: of the last pass, with keyframes as they are now, and what was measured.
            gates: [N,h,w] in [0,1] of all keyframes.
        """
        if not self.made:
            return
        store, rows = self._optimiser.store, graph.select()
        least = _LOOSE * explained_share(store, graph, rows, gates)
        agrees = explained_around(store, graph, rows, gates).tolist()
        loose = [k for k in self._numbers() if agrees[k] < least]
        for k in loose:
            _log.info("frame %d is no keyframe any more: it came loose", store.infos[k].index)
        self._take_out(loose)

    def _numbers(self) -> list[int]:
        """Numbers of the keyframes from between others."""
        infos = self._optimiser.store.infos
        return [k for k, info in enumerate(infos) if info.index in self._added]

    def _take_out(self, numbers: Sequence[int]) -> None:
        store = self._optimiser.store
        for number in reversed(numbers):
            self._added.remove(store.infos[number].index)
            store.remove(number)

    def old(self) -> list[int]:
        """Numbers of the keyframes that are not from between others."""
        infos = self._optimiser.store.infos
        return [k for k, info in enumerate(infos) if info.index not in self._added]

    def _known(self, filler: Filler, time: float, pose: Tensor) -> dict[str, Tensor]:
        """Fields of a frame by the nearer keyframe beside it: hardly anything moves in between."""
        store = self._optimiser.store
        times = store.times()
        near = min(filler.neighbours(time), key=lambda k: abs(times[k] - time))
        T_cw = torch.stack([store.T_cw[near], pose])
        disp = carry_depth(store.disps[near], T_cw, store.intrinsics)
        return {"T_cw": pose, "disps": disp, "through": store["through"][near].clone()}
