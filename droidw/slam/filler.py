"""Poses of all frames between the keyframes (REFERENCE 5.8)."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from droidw.geometry.interpolate import interpolate
from droidw.geometry.se3 import exp, identity, inv, log, mul
from droidw.slam.frame import Trajectory
from droidw.slam.locate import locate
from droidw.slam.smoothing import smoothed

if TYPE_CHECKING:
    from droidw.config.schema import DroidwConfig
    from droidw.slam.motion_filter import Encoded
    from droidw.slam.optimise import Optimiser

__all__ = ["Filler"]


class Filler:
    """Interpolates a frame between its two keyframes, refines it, motion only, and smooths all."""

    def __init__(self, optimiser: Optimiser, config: DroidwConfig) -> None:
        self.optimiser = optimiser
        self.config = config
        store = optimiser.store
        self._times = store.times()
        self._rows = {info.index: row for row, info in enumerate(store.infos)}
        self._gates = optimiser.gates(learned=config.schedule["fill"].weigh)

    def is_keyframe(self, index: int) -> bool:
        """Whether frame `index` is a keyframe and needs no filling."""
        return index in self._rows

    def keyframe_pose(self, index: int) -> Tensor:
        """Pose [7] of the keyframe made from frame `index`."""
        return self.optimiser.store.T_cw[self._rows[index]]

    def neighbours(self, time: float) -> tuple[int, int]:
        """The keyframes before and after `time`; equal at either end."""
        after = bisect_right(self._times, time)
        before = max(after - 1, 0)
        return before, min(after, len(self._times) - 1)

    def start(self, time: float) -> Tensor:
        """Interpolated pose [7] at `time`; held motion beyond the last keyframe."""
        T_cw = self.optimiser.store.T_cw
        if not self._times:  # tracking failed before the first one
            return identity(dtype=T_cw.dtype, device=T_cw.device)
        before, after = self.neighbours(time)
        if before != after:
            share = (time - self._times[before]) / (self._times[after] - self._times[before])
            return interpolate(T_cw[before], T_cw[after], share)
        hold = self.config.frontend.predict == "hold"
        if before == 0 or hold or time <= self._times[before]:
            return T_cw[before]
        span = self._times[before] - self._times[before - 1]
        ahead = min((time - self._times[before]) / span, 1.0)
        velocity = log(mul(T_cw[before], inv(T_cw[before - 1])))
        return mul(exp(velocity * ahead), T_cw[before])

    def fill(self, frames: Iterable[Encoded]) -> list[Tensor]:
        """Poses [7] of a batch of frames that are not keyframes."""
        batch = list(frames)
        start = torch.stack([self.start(e.frame.time) for e in batch])
        updates = self.config.filler.updates
        if updates == 0 or len(self._times) < 2:
            return list(start.unbind(0))
        return list(self._refine(batch, start, updates).unbind(0))

    def trajectory(
        self,
        indices: Sequence[int],
        times: Sequence[float],
        rest: Iterable[Encoded] | None,
        tell: Callable[[int], None],
    ) -> Trajectory:
        """A pose for every frame.

        Args:
            indices, times: of all frames. rest: those that are no keyframes; None: these are
                interpolated, and no more. tell: how many of them are done, now and then.
        """
        poses: dict[int, Tensor] = {}
        pending = iter(rest or ())
        while batch := list(islice(pending, self.config.filler.batch)):
            for encoded, pose in zip(batch, self.fill(batch), strict=True):
                poses[encoded.frame.index] = pose
            tell(len(poses))
        for index, time in zip(indices, times, strict=True):
            if self.is_keyframe(index):
                poses[index] = self.keyframe_pose(index)
            elif index not in poses:
                poses[index] = self.start(time)
        T_cw = torch.stack([poses[i] for i in indices]).double()
        held = np.asarray([self.is_keyframe(i) for i in indices])
        if rest is not None:
            T_cw = self.smoothed(T_cw, times, held)
        stamps = np.asarray(times, dtype=np.float64)
        return Trajectory(times=stamps, T_wc=inv(T_cw).cpu().numpy(), is_keyframe=held)

    def smoothed(self, T_cw: Tensor, times: Sequence[float], held: npt.NDArray[np.bool_]) -> Tensor:
        """The whole path [N,7], float64, with frames that are no keyframes on a steady motion.

        Args:
            times: [N]. held: [N], keyframes.
        """
        options = self.config.filler
        return smoothed(T_cw, times, held) if options.smooth and options.updates else T_cw

    def _refine(self, batch: list[Encoded], start: Tensor, updates: int) -> Tensor:
        return locate(
            self.optimiser,
            [encoded.payload for encoded in batch],
            start,
            [self._sources(encoded.frame.time) for encoded in batch],
            self._gates,
            updates=updates,
            iterations=self.config.schedule["fill"].iterations,
            solver=self.config.filler_solver,
        )

    def _sources(self, time: float) -> list[int]:
        """Keyframes on either side of `time`; at the last one, those behind it and one more."""
        before, after = self.neighbours(time)
        count = self.config.filler.keyframes
        first, end = before - count + 1, after + count
        if before == after and self.config.frontend.predict != "hold":
            first, end = before - count, after + 1
        return list(range(max(first, 0), min(end, len(self._times))))
