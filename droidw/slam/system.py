"""The orchestrator: frames in, trajectory and keyframes out, in one process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from droidw.errors import InputError
from droidw.events import Dispatcher, FrameTracked, KeyframeAdded, KeyframeRemoved, Progress
from droidw.geometry.camera import Grid
from droidw.graph.store import KeyframeStore
from droidw.interfaces.correspondence import SetsAside
from droidw.interfaces.uncertainty import Renews
from droidw.io.prefetch import prefetch
from droidw.slam.backend import Backend
from droidw.slam.backwards import doubted
from droidw.slam.between import Between
from droidw.slam.cell_maps import CellMaps
from droidw.slam.cloud import confirmed, static_cloud
from droidw.slam.diagnosis import diagnose, parallax, unusable
from droidw.slam.filler import Filler
from droidw.slam.focal import FocalSearch
from droidw.slam.frame import CloudPoints, Frame, KeyframeRecord, Trajectory
from droidw.slam.frontend import Frontend
from droidw.slam.keyframes import Keyframes
from droidw.slam.metric import deeper, scale_to_prior
from droidw.slam.motion_filter import Encoded, MotionFilter, Verdict
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.records import Outcome, keyframe_records
from droidw.slam.streams import Ahead, nbytes
from droidw.slam.timing import Stopwatch
from droidw.solve.weights import CLOSED

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.config.schema import DroidwConfig
    from droidw.geometry.camera import Camera

__all__ = ["SlamSystem"]

# Frames that are encoded and judged ahead of the one being tracked.
_LOOK_AHEAD = 32


class SlamSystem:
    """Composes the parts into motion filter, frontend, backend and filler.

    `track` all frames, or feed them one by one with `push`; then `finish`.

    Args:
        config: resolved configuration.
        parts: the plugins, built.
        camera: the working camera (after rectification).
        device: where tensors live.
        events: who hears what happens.
        threaded: whether correspondence may be called from another thread, ahead of time.
        focal_known: the focal length of `camera` is a calibration, not a guess.
        hidden: index of a frame -> [H,W] True where its picture is ignored while tracking, or None;
            global adjustment and the filler see all of it.
        clock: where the time of each stage is added up.
        stopped: asked now and then whether the run is to end soon.
    Attributes:
        camera: the working camera, after `finish` with the focal length that was found.
        focal: what the search for that came to, None where there was none.
    """

    def __init__(
        self,
        config: DroidwConfig,
        parts: Parts,
        camera: Camera,
        device: torch.device,
        events: Dispatcher | None = None,
        *,
        threaded: bool = False,
        focal_known: bool = True,
        hidden: Callable[[int], npt.NDArray[np.bool_] | None] | None = None,
        clock: Stopwatch | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.config = config
        self.parts = parts
        self.camera = camera
        self.focal: FocalSearch | None = None
        self._focal_known = focal_known
        self.events = events or Dispatcher()
        self.clock = clock or Stopwatch()
        self._stopped = stopped
        op = parts.correspondence
        self.grid = Grid.of(camera.height, camera.width, op.stride, op.offset)
        # The published code takes depth and features from pixel 8 x + 3, but its rays from 8 x.
        shifted = "droid-w" in config.compat and (op.stride, op.offset) == (8, 0)
        picked = replace(self.grid, offset=3.0) if shifted else self.grid
        self._maps = CellMaps(parts, self.grid, picked, device, self.clock)
        if min(self.grid.height, self.grid.width) < 3:
            raise InputError(
                f"pictures of {camera.width}x{camera.height} px leave a grid of "
                f"{self.grid.width}x{self.grid.height} cells, too few to track",
                "at least 3 cells each way are needed; enlarge camera.long_side",
            )
        self.store = KeyframeStore(
            self.grid,
            camera.intrinsics(),
            parts.features.dim,
            parts.uncertainty.fields,
            device,
            getattr(parts.features, "dtype", torch.float32),
        )
        self.optimiser = Optimiser(
            self.store,
            parts,
            config.weighting,
            self.clock,
            "droid-w" in config.compat,
            config.lines,
        )
        self.frontend = Frontend(self.optimiser, config)
        self._look_ahead = _LOOK_AHEAD if threaded else 0
        self._ahead = Ahead(device, threaded)
        self._filter = MotionFilter(op, config.motion_filter, threaded)
        begins, model = self.optimiser.begins, parts.uncertainty
        self._renews = begins and isinstance(model, Renews) and model.renews
        self._aside = begins and isinstance(op, SetsAside)
        self._keyframes = Keyframes(self.optimiser, self._maps, self._renews)
        self._times: list[float] = []
        self._indices: list[int] = []
        self._matched: list[float] = []
        self._kept: dict[int, object] = {}
        self._newest: tuple[Encoded, Verdict] | None = None
        self._hidden = hidden or (lambda index: None)
        self._room = config.filler.cache_mb * 1e6

    @property
    def frames(self) -> int:
        """How many frames have been tracked."""
        return len(self._times)

    @property
    def last_index(self) -> int:
        """Index in the source of the frame tracked last, -1 before the first."""
        return self._indices[-1] if self._indices else -1

    # -- tracking --------------------------------------------------------------------------

    def track(self, frames: Iterable[Frame]) -> None:
        """Push all frames; the motion filter runs ahead of the window where it can."""
        judged = (self._judge(frame) for frame in frames)
        with closing(prefetch(judged, self._look_ahead, self._filter.close)) as ahead:
            for current, verdict in ahead:
                self._push(current, verdict)

    def push(self, frame: Frame) -> bool:
        """Track one frame; returns whether it is a keyframe now."""
        return self._push(*self._judge(frame))

    def _judge(self, frame: Frame) -> tuple[Encoded, Verdict]:
        """Encode a frame and say whether it becomes a keyframe; if it does, make all it needs."""
        with self._ahead.working():
            current = self._hide(self._encode(frame))
            with self.clock("motion filter"):
                verdict = self._filter.judge(current)
            if verdict.keep:
                current = self._with_movable(self._with_context(current))
            if verdict.keep and self._look_ahead > 0:
                maps = self._maps
                current = replace(current, features=maps.features(frame), prior=maps.prior(frame))
            return replace(current, ready=self._ahead.ready()), verdict

    def _hide(self, plain: Encoded) -> Encoded:
        """The frame without what is hidden of it, and beside that as it is."""
        hidden, frame = self._hidden(plain.frame.index), plain.frame
        if hidden is None:
            return plain
        mask = torch.from_numpy(hidden)
        mask = mask if frame.mask is None else mask | frame.mask
        return replace(self._encode(replace(frame, mask=mask)), plain=plain)

    def _with_context(self, current: Encoded) -> Encoded:
        """What correspondence needs of a keyframe, too."""
        op = self.parts.correspondence
        plain = current.plain
        if plain is not None:
            plain = self._with_context(plain)
        context = op.context(current.payload, current.frame, self.grid)
        return replace(current, context=context, plain=plain)

    def _with_movable(self, current: Encoded) -> Encoded:
        """What can move in a keyframe, where anyone asks; the filter is told what is hidden."""
        above, frame = self.config.motion_filter.movable_above, current.frame
        aside = self._aside and above > 0
        movable = self._movable(frame, aside)
        cells = movable > above if aside and movable is not None else None
        masked = None if frame.mask is None else self._maps.unmasked(frame) < CLOSED
        self._filter.set_aside(current, cells, masked)
        return current if movable is None else replace(current, movable=movable)

    def _movable(self, frame: Frame, aside: bool = False) -> Tensor | None:
        """What can move in a keyframe, where uncertainty asks, or it is to be set aside."""
        # Uncertainty begins with the first keyframes, and learns anew with all of them.
        anew = self.config.backend.learn or not self.frontend.initialised
        asked = self._renews or aside or (self.optimiser.begins and anew)
        return self._maps.movable(frame) if asked else None

    def _held(self, frame: Frame) -> Encoded:
        """A frame read again, with what is held of it."""
        held = self._kept.get(frame.index)
        return self._encode(frame) if held is None else Encoded(frame, held)

    def _encode(self, frame: Frame) -> Encoded:
        with self.clock("encode"):
            return Encoded(frame, self.parts.correspondence.encode(frame, self.grid))

    def _push(self, current: Encoded, verdict: Verdict) -> bool:
        frame = current.frame
        maps = current.features, current.prior, current.movable
        made = (current.payload, current.context, *maps)
        plain = current.plain
        whole = None if plain is None else (plain.payload, plain.context)
        self._ahead.take(current.ready, made, whole)
        self._times.append(frame.time)
        self._indices.append(frame.index)
        if verdict.motion is not None:
            self._matched.append(verdict.motion.matched)
        self._remember(current)
        kept = False
        if verdict.keep:
            kept = self._keyframe(current, verdict.forced)
        self._newest = None if kept else (current, verdict)
        self.events.emit(FrameTracked(frame.index, frame.time, len(self._times), len(self.store)))
        return kept

    def _remember(self, current: Encoded) -> None:
        """Hold the payload for the filler while there is room; beyond, frames are read again."""
        payload = (current.plain or current).payload
        size = nbytes(payload)
        if size <= self._room:
            self._room -= size
            self._kept[current.frame.index] = payload

    def _keyframe(self, current: Encoded, forced: bool) -> bool:
        number = self._append(current)
        self.events.emit(KeyframeAdded(number, current.frame.index))
        with self.clock("frontend"):
            infos = list(self.store.infos)
            dropped = self.frontend.grow(forced)
        if dropped is not None:
            self.events.emit(KeyframeRemoved(dropped, infos[dropped].index))
        self._filter.settled(current.frame.index, dropped != number)
        return dropped != number

    def _append(self, current: Encoded) -> int:
        return self._keyframes.append(current, *self.frontend.guess(current.frame.time))

    # -- finishing -------------------------------------------------------------------------

    def finish(self, reread: Callable[[], Iterable[Frame]], *, brief: bool = False) -> Outcome:
        """Global bundle adjustment, then a pose for every frame.

        Args:
            reread: a fresh pass over the same frames, for those that could not be held.
            brief: after an interruption: no global passes, and only interpolated poses.
        """
        if not brief:
            self._end()
        if not self.frontend.initialised and len(self.store) >= 2:
            with self.clock("frontend"):
                self.frontend.initialise()
        self.frontend.release()
        self._reveal()
        found = diagnose(
            self.store, self.frames, self._matched, self.config.motion_filter.lost_below
        )
        if found.still:
            self._hold_still()
        elif not brief:
            with self.clock("global"):
                self.optimiser.upright.again()
                backend = Backend(
                    self.optimiser,
                    self.config,
                    self._focal_known,
                    fresh=True,
                    between=self._between(reread),
                )
                backend.run(lambda done, total: self.events.emit(Progress("global", done, total)))
                self._refined(backend.focal)
                found = replace(found, agreement=backend.agreement, weakest=backend.weakest)
            found = doubted(self.optimiser, self.config, found, self.events, self._stopped)
        if self.parts.depth.metric and not found.still:
            valid = confirmed(self.store, self.config, self.optimiser.gates())
            scale_to_prior(self.store, valid, deeper(self.parts.depth, self.focal))
        with self.clock("fill"):
            trajectory = self._trajectory(reread, quick=brief or found.still)
        self._kept.clear()
        with self.clock("cloud"):
            records, cloud = self._records()
        if not found.still:
            share = parallax(self.store, self.optimiser.gates())
            found = replace(found, parallax=share, points=len(cloud.xyz))
        return Outcome(
            trajectory=trajectory,
            keyframes=records,
            cloud=cloud,
            diagnosis=found,
            camera=self.camera,
            grid=self.grid,
            focal=self.focal,
            last_index=self.last_index,
            metric=self.parts.depth.metric and bool((self.store["prior"] > 0).any()),
            reports={**self.optimiser.reports, **unusable(self.store)},
        )

    def _end(self) -> None:
        """Make the last frame a keyframe if it has moved on from the one before."""
        if self._newest is not None:
            current, verdict = self._newest
            self._newest = None
            none = len(self.store) == 0  # all of them were blank
            if none or self._filter.ends(verdict, self.store.infos[-1].index):
                self._keyframe(self._with_movable(self._with_context(current)), forced=True)

    def _between(self, reread: Callable[[], Iterable[Frame]]) -> Between:
        """What makes keyframes of frames between the others, from a second pass."""

        def encoded(indices: set[int]) -> Iterator[Encoded]:
            for frame in reread():
                if frame.index in indices:
                    current = self._with_context(self._held(frame))
                    yield replace(current, movable=self._movable(frame))

        def insert(made: Sequence[tuple[Encoded, dict[str, Tensor]]]) -> None:
            for number in self._keyframes.insert(made):
                self.events.emit(KeyframeAdded(number, self.store.infos[number].index))

        return Between(self.optimiser, self.config, self._indices, encoded, insert)

    def _reveal(self) -> None:
        """From now on nothing is hidden: matches are made with whole pictures."""
        for number, info in enumerate(self.store.infos):
            if info.whole is not None:
                info.payload, self.store["unmasked"][number] = info.whole
                info.whole = None

    def _refined(self, focal: FocalSearch | None) -> None:
        """Take over the focal length that global adjustment found."""
        self.focal = focal
        if focal is not None and focal.factor != 1.0:
            fx, fy = self.camera.fx * focal.factor, self.camera.fy * focal.factor
            self.camera = replace(self.camera, fx=fx, fy=fy)

    def _hold_still(self) -> None:
        """A camera at rest: every pose is the first, and no depth can be known."""
        self.store.T_cw.copy_(self.store.T_cw[:1].clone().expand_as(self.store.T_cw))

    def _trajectory(self, reread: Callable[[], Iterable[Frame]], quick: bool) -> Trajectory:
        filler, count = Filler(self.optimiser, self.config), len(self._times)
        rest = None if quick else self._unfilled(filler, reread)
        return filler.trajectory(
            self._indices,
            self._times,
            rest,
            lambda done: self.events.emit(Progress("fill", done, count)),
        )

    def _unfilled(self, filler: Filler, reread: Callable[[], Iterable[Frame]]) -> Iterator[Encoded]:
        """Every frame that is no keyframe, from memory or from a second pass."""
        if len(self._kept) == len(self._indices):
            blank = torch.zeros(0)
            for index, time in zip(self._indices, self._times, strict=True):
                if not filler.is_keyframe(index):
                    yield Encoded(Frame(index, time, blank, blank), self._kept[index])
            return
        known = set(self._indices)
        for frame in reread():
            if frame.index in known and not filler.is_keyframe(frame.index):
                yield self._held(frame)

    def _records(self) -> tuple[tuple[KeyframeRecord, ...], CloudPoints]:
        store, cloud = self.store, self.config.cloud
        if len(store) == 0:
            return (), static_cloud(store, torch.zeros(0), torch.zeros(0), cloud)
        weight = self.optimiser.gates()
        valid = confirmed(store, self.config, weight)
        records = keyframe_records(store, valid, weight)
        return records, static_cloud(store, valid, weight, cloud)
