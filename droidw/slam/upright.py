"""Keyframes turned as the lines they see say."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from droidw.geometry.se3 import from_matrix, inv, mul, rotation
from droidw.geometry.transfer import upload
from droidw.interfaces.correspondence import FindsLines
from droidw.slam.doubt import doubtful
from droidw.solve.manhattan import (
    Axes,
    LineRays,
    axes_in_turn,
    next_axes,
    rotation_term,
    shared_axes,
)
from droidw.solve.planes import held_to_planes
from droidw.solve.weights import CLOSED, closed_share

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.config.schema import LinesConfig
    from droidw.graph.store import KeyframeStore
    from droidw.interfaces.correspondence import Correspondence
    from droidw.slam.timing import Stopwatch
    from droidw.solve.problem import BAProblem, PoseTerm

__all__ = ["Upright"]

_log = logging.getLogger(__name__)

# Share of the length of lines that must agree with the axes of a picture, for these to count.
_KNOWN = 0.6
# Share of all cells that are closed, from which lines that did not count are asked once more: where
# nothing is hidden, all keyframes say what the first ones said.
_HIDDEN = 0.05
# How many keyframes there are when they are asked again for the first time, a power of two.
_AGAIN = 16


class Upright:
    """Measures the axes of keyframes in the store, and holds poses to them.

    Whether a scene has lines along three directions at right angles is decided when tracking
    begins, by the first keyframes: half of them must have `least_share` of the length of their
    lines along these. It is decided anew before global adjustment, by all of them, when it is known
    what moves; and where they did not count though much is hidden, whenever there are twice as many
    keyframes. Where a scene has no such lines, nothing here does anything.

    Args:
        store: has the fields `axes` and `axes_information`.
        correspondence: only one that `FindsLines` is asked.
        options: how much lines count, and where; None: nowhere.
        gates: number of the first keyframe -> [n,h,w] in [0,1], what of each is open.
        clock: where the time is added up.
    Attributes:
        holds: whether lines count. None before that is decided.
    """

    def __init__(
        self,
        store: KeyframeStore,
        correspondence: Correspondence,
        options: LinesConfig | None,
        gates: Callable[[int], Tensor],
        clock: Stopwatch,
    ) -> None:
        self._store = store
        self._finder = correspondence if isinstance(correspondence, FindsLines) else None
        self._weight = 0.0 if options is None else options.weight
        self._least_share = 0.0 if options is None else options.least_share
        self._doubt = 1.0 if options is None else options.doubt
        self._gates = gates
        self._clock = clock
        self._asked = self._finder is not None and self._weight > 0
        self.holds: bool | None = None if self._asked else False

    def see(self, number: int) -> None:
        """Find the lines of a keyframe just added, and turn it as they say.

        Where lines do not count, one that is appended may be reason to ask all of them again.
        """
        store = self._store
        if self.holds is False:
            if number + 1 == len(store) and _due(len(store)):
                self.again()
            return
        with self._clock("lines"):
            self._look(number)
            if self.holds is None:
                return
            known = self._known()
            expected = rotation(store.T_cw[number].double()) @ self._world(known)
            near = [expected.cpu().numpy()]
            if known:  # poses may have drifted against the world, but hardly since then
                beside = min(known, key=lambda k: abs(k - number))
                since = mul(store.T_cw[number].double(), inv(store.T_cw[beside].double()))
                near.append((rotation(since) @ store["axes"][beside]).cpu().numpy())
            self._keep(
                number, next_axes(self._rays(self._lines(number), self._gates(number)[0]), near)
            )
            self.turn(number)

    def begin(self) -> None:
        """Decide by the keyframes so far whether lines count; if so, turn these."""
        if self.holds is None:
            self.holds = True
            share = self.measure()
            self.holds = share >= self._least_share
            if self.holds:
                _log.info(
                    "%.0f %% of the length of lines is along three directions at right angles: "
                    "they tell how the camera is turned (lines.weight=0 does not ask them)",
                    100 * share,
                )
                for number in range(len(self._store)):
                    self.turn(number, still=True)

    def again(self) -> None:
        """Measure the axes of all keyframes, by gates and focal length of now, and decide anew.

        Where half of the keyframes no longer agree with theirs, lines do not count from then on.
        What moves may have hidden lines from the first keyframes, and has edges of its own: where
        half of all keyframes agree now, lines count from then on, and these are turned.
        """
        held = bool(self.holds)
        if not (held or (self._asked and closed_share(self._gates(0)) >= _HIDDEN)):
            return
        with self._clock("lines"):
            for number, info in enumerate(self._store.infos):
                if info.lines is None:  # nobody asked since lines did not count
                    self._look(number)
        self.holds = True
        share = self.measure()
        self.holds = share >= self._least_share
        if self.holds == held:
            return
        _log.info(
            "lines %s: %.0f %% of their length is along three directions at right angles, and "
            "lines.least_share is %.2f",
            "count from now on" if self.holds else "no longer count",
            100 * share,
            self._least_share,
        )
        if self.holds:
            for number in range(len(self._store)):
                self.turn(number)

    def _look(self, number: int) -> None:
        """Find the lines of a keyframe, where correspondence can."""
        if self._finder is not None:
            info = self._store.infos[number]
            info.lines = np.asarray(
                self._finder.line_segments(self._store.payload(number)), np.float32
            )

    def measure(self) -> float:
        """The same, and lines count as before.

        Returns:
            The share of the length of lines that agrees with them, of half of the keyframes.
        """
        if not self.holds:
            return 0.0
        with self._clock("lines"):
            gates = self._gates(0)
            count = len(self._store)
            found = axes_in_turn([self._rays(self._lines(k), gates[k]) for k in range(count)])
            for number, axes in enumerate(found):
                self._keep(number, axes)
        shares = [0.0 if axes is None else axes.share for axes in found]
        return float(np.median(shares)) if shares else 0.0

    def refit(self) -> float:
        """Fit the axes that are known to their lines again, by the focal length of now.

        Those of the same keyframes count as before, so that what they cost can be compared.

        Returns:
            What all lines of these keyframes are off, as `term` counts it where `usual` is 1.
        """
        energy = 0.0
        if self.holds:
            with self._clock("lines"):
                gates = self._gates(0)
                for number in self._known():
                    rays = self._rays(self._lines(number), gates[number])
                    axes = rays.axes(rays.fitted(self._store["axes"][number].cpu().numpy()))
                    self._set(number, axes)
                    energy += rays.energy(axes.turn)
        return self._weight * energy

    def like(self, other: Upright) -> None:
        """Let lines count as for another store, of the same keyframes."""
        self.holds = other.holds

    def doubts(self, agreement: float, below: float) -> bool:
        """Whether a run is in doubt; `doubtful`, with less that has to agree where lines count.

        Args:
            agreement, below: as of `doubtful`, without lines.
        """
        return doubtful(agreement, below * self._doubt if self.holds and below < 1.0 else below)

    def turn(self, number: int, still: bool = False) -> None:
        """Turn a keyframe about its centre as its lines say, where they do.

        Args:
            still: it keeps its translation instead of its centre.
        """
        store = self._store
        if not self.holds or not bool(store["axes_information"][number].any()):
            return
        pose = store.T_cw[number].double()
        turned = torch.zeros(3, 4, dtype=pose.dtype, device=pose.device)
        turned[:, :3] = store["axes"][number] @ self._world(self._known()).mT
        centre = inv(pose)[:3]
        turned[:, 3] = pose[:3] if still else -turned[:, :3] @ centre
        store.T_cw[number] = from_matrix(turned).to(store.T_cw)

    def term(
        self, T_cw: Tensor, first: int, usual: float, settled: bool = False
    ) -> PoseTerm | None:
        """What lines say of the poses [N,7] of the keyframes from `first` on.

        Args:
            usual: square of a usual residual, the unit in which they count.
            settled: as of `rotation_term`.
        """
        store = self._store
        known = self._known() if self.holds else []
        if not known:
            return None
        information = store["axes_information"][first:]
        weight = self._weight * usual
        world = self._shared(known)
        return rotation_term(T_cw, store["axes"][first:], information, world, weight, settled)

    def flat(self, problem: BAProblem, gates: Tensor, weight: float) -> BAProblem:
        """A problem of all keyframes with walls and floors held to be flat, where lines count.

        Args:
            gates: [N,h,w]. weight: in the units of the energy of `BAProblem`.
        Returns:
            It may have keyframes behind the others, as of `held_to_planes`. A problem of some
            keyframes is returned as it is.
        """
        if not self.holds or weight <= 0 or len(problem.T_cw) < len(self._store):
            return problem
        return held_to_planes(problem, self._shared(self._known()), gates, weight)

    def _known(self) -> list[int]:
        """Keyframes whose axes count."""
        known = self._store["axes_information"].flatten(1).any(dim=1)
        return [int(k) for k in known.nonzero().flatten().tolist()]

    def _world(self, known: list[int]) -> Tensor:
        """[3,3] float64 from the axes to the world: as the first keyframe that has them sees it.

        The first pose is held while others move, so it is what a path that is not known goes by.
        """
        return self._shared(known[:1])

    def _shared(self, known: list[int]) -> Tensor:
        """The same as most of the keyframes see it that agree with the first."""
        store = self._store
        if not known:
            return torch.eye(3, dtype=torch.float64, device=store.device)
        at = upload(torch.tensor(known), store.device)
        return shared_axes(store.T_cw[at], store["axes"][at], store["axes_information"][at])

    def _lines(self, number: int) -> npt.NDArray[np.float32]:
        lines = self._store.infos[number].lines
        return np.zeros((0, 4), np.float32) if lines is None else lines

    def _rays(self, segments: npt.NDArray[np.float32], gate: Tensor) -> LineRays:
        """Lines of a picture, but for those whose middle is closed."""
        open_ = self._open(segments, gate.cpu().numpy())
        return LineRays(segments[open_], self._store.image_intrinsics.double().cpu().tolist())

    def _open(
        self, segments: npt.NDArray[np.float32], gate: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.bool_]:
        grid = self._store.grid
        middle = 0.5 * (segments[:, :2] + segments[:, 2:])
        cell = np.rint((middle - grid.offset) / grid.stride).astype(np.int64)
        x, y = cell[:, 0].clip(0, grid.width - 1), cell[:, 1].clip(0, grid.height - 1)
        return np.asarray(gate[y, x] >= CLOSED)

    def _keep(self, number: int, axes: Axes | None) -> None:
        if axes is None or axes.share < _KNOWN:
            self._store["axes_information"][number] = 0.0
        else:
            self._set(number, axes)

    def _set(self, number: int, axes: Axes) -> None:
        store = self._store
        store["axes"][number] = upload(torch.from_numpy(axes.turn), store.device)
        store["axes_information"][number] = upload(torch.from_numpy(axes.information), store.device)


def _due(count: int) -> bool:
    """Whether lines that do not count are asked again with so many keyframes."""
    return count >= _AGAIN and count & (count - 1) == 0
