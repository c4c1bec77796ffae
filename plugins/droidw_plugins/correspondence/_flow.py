"""Implementation of correspondence `flow`."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from droidw.geometry.contour import grown
from droidw.interfaces.correspondence import Motion, Purpose
from droidw.solve.weights import CLOSED
from droidw_plugins.correspondence._flow_check import Checks
from droidw_plugins.correspondence._flow_exposure import as_bright
from droidw_plugins.correspondence._flow_information import agreement, sample, structure
from droidw_plugins.correspondence._flow_lines import line_segments
from droidw_plugins.correspondence._flow_mask import (
    rounded,
    searched,
    softened,
    surer,
    without,
)
from droidw_plugins.correspondence._flow_motion import picture_motion
from droidw_plugins.correspondence._flow_polish import SMALLEST, polished, polished_through
from droidw_plugins.correspondence._flow_raster import Raster
from droidw_plugins.correspondence._flow_search import DenseSearch, seen_through
from droidw_plugins.correspondence._flow_seeds import SeedBook, Seeds, drawn
from droidw_plugins.correspondence._flow_session import FlowSession
from droidw_plugins.correspondence._flow_types import (
    Array,
    Edge,
    FlowFrame,
    Found,
    Kept,
    KeptInRounds,
    Track,
    set_out_from,
    taken_out_alike,
)

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.geometry.camera import Grid
    from droidw.slam.frame import Frame
    from droidw_plugins.correspondence.flow import FlowOptions

_Pair = tuple[tuple[int, int], tuple[int, int]]  # keys of both frames
# Keyframes whose flow from the one before is kept at full size, from the motion filter until an
# edge wants it: so many that what is found does not depend on how far ahead the filter has run.
_FULL_FIELDS = 64
# Matched share below which the motion so far says nothing of the next picture.
_TRACKED = 0.1
# Grid flows kept for the filler: some ten kilobytes each.
_GRID_FIELDS = 20_000
# Cells by which predictions may have moved, in the median, since a pair was searched, for the next
# search to be of what hardly moves.
_NEAR_START = 0.5
# `again_coarsest` that leaves out none.
_ALL_LEVELS = 8
# Pixels between a seed and the flow that was found for which a search sets out from the seeds, and
# how many times as sure a match of it has to be.
_SEEDED = 1.5
_CLEARLY = 1.05
# Checked pairs kept for the next session that asks for them, and what was found between whole
# pictures: some forty kilobytes each.
_PAIRS = 4_000


class FlowCorrespondence:
    """Measures flow between pairs of frames with a small pool of threads."""

    def __init__(self, options: FlowOptions) -> None:
        self.options = options
        self.stride = options.stride
        self.offset = (options.stride - 1) / 2
        self._track: Track | None = None
        # Index of the frame measured last, and the least by which it has grown: the stride.
        self._newest: int | None = None
        self._step = 0
        self._raster = Raster(self.stride, self.offset)
        workers = options.workers or os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="flow")
        self._dense = DenseSearch(options, self._raster)
        self._checks = Checks(options, self._raster)
        self._latest: tuple[_Pair, Array] | None = None
        self._full: Kept[_Pair, Array] = Kept(_FULL_FIELDS)
        self._grid: Kept[_Pair, Array] = Kept(_GRID_FIELDS)
        self._seeds = SeedBook(options.seeds)
        self._pairs: KeptInRounds[tuple[Hashable, ...], tuple[Edge, Edge]] = KeptInRounds(_PAIRS)
        self._plain: KeptInRounds[tuple[Hashable, ...], tuple[Found, Found]] = KeptInRounds(_PAIRS)

    def encode(self, frame: Frame, grid: Grid) -> FlowFrame:
        """Grey image, less what the user's mask covers, and its structure at the cells."""
        rgb = cv2.merge(list(frame.image.cpu().numpy()))
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        centres = grid.centres().numpy().astype(np.float32)
        scaled = grey * np.float32(255.0)
        picture = rounded(scaled)
        covered = flat = None
        if frame.mask is not None:
            covered = frame.mask.cpu().numpy()
            picture = without(picture, covered)
            scaled = picture.astype(np.float32)
            flat = grown(covered, self.options.reach) if self.options.reach else None
        soft, unsoftened = searched(picture, self.options.blur)
        seen = structure(softened(scaled, self.options.blur), centres, self.stride, flat)
        return FlowFrame(
            frame.index, soft, *seen, centres, self.stride, covered, unsoftened=unsoftened
        )

    def context(self, payload: FlowFrame, frame: Frame, grid: Grid) -> FlowFrame:
        """Nothing more is needed of a keyframe; the flow that made it one is kept for its edge."""
        if self._latest is not None and self._latest[0][1] == payload.key:
            key, flow = self._latest
            self._full.put(key, flow)
        return payload

    def motion(self, reference: FlowFrame, current: FlowFrame) -> Motion:
        """Flow from the reference, judged by brightness agreement only.

        The search starts where a picture that goes on moving as it did would be: a free search
        loses a camera that is fast before walls with little on them.
        """
        self._count(reference, current)
        if not (current.texture.max(axis=-1) > 0.5 * self.options.texture).any():
            self._track = None
            return Motion(0.0, 0.0)  # a blank picture agrees with whatever is as bright
        start = None if self._track is None else self._track.ahead(reference, current, self._step)
        flow = self._search(reference, current, start)
        self._latest = (reference.key, current.key), flow
        moved = self._moved(reference, current, lambda a, b: flow)
        agrees = agreement(reference, current, moved, self._checks.gain(reference, current, moved))
        motion = picture_motion(moved, agrees, reference, self.options)
        known = motion.matched > _TRACKED
        self._track = Track.after(self._track, reference, current, flow) if known else None
        return motion

    def _count(self, reference: FlowFrame, current: FlowFrame) -> None:
        """Note by how much the index grows from one frame to the next."""
        grown = current.index - (reference.index if self._newest is None else self._newest)
        self._newest = current.index
        if grown > 0:
            self._step = min(self._step or grown, grown)

    def aside(self, payload: FlowFrame, cells: Tensor) -> FlowFrame:
        """The frame, as one whose `cells`, bool [h,w], do not tell how far a picture moved."""
        return replace(payload, aside=cells.cpu().numpy())

    def session(self, purpose: Purpose = "window") -> FlowSession:
        """Fresh edge state; flows already measured are shared between sessions."""
        return FlowSession(self, one_way=purpose == "fill", fine=purpose == "global")

    def matched_points(self, a: FlowFrame, b: FlowFrame, gate_a: Array, gate_b: Array) -> Array:
        """Points matched by their descriptors and held in both pictures, [n,4].

        But for those on what gates [h,w] close.
        """
        if not self.options.seeds:
            return np.zeros((0, 4), np.float32)
        below = self.options.bridge or CLOSED
        seeds = self._seeds.between(a, b, gate_a < below, gate_b < below)
        return np.concatenate([seeds.here, seeds.there], axis=1)[seeds.held]

    def line_segments(self, payload: FlowFrame) -> Array:
        """Straight edges of the picture, [n,4] ends x, y, x, y in pixels."""
        return line_segments(payload.grey if payload.unsoftened is None else payload.unsoftened)

    # -- measuring -------------------------------------------------------------------------

    def _search(
        self,
        a: FlowFrame,
        b: FlowFrame,
        start: Array | None = None,
        fine: bool = False,
        near: bool = False,
        warped: bool = False,
        bend: Array | None = None,
    ) -> Array:
        """Dense flow a -> b, [H,W,2] pixels; see `DenseSearch`."""
        moved = None if start is None else sample(start, a.centres)
        grey = as_bright(b.grey, self._checks.gain(a, b, moved))
        if warped and start is not None:
            return self._dense.warped(a.grey, grey, start, bend, fine=fine, near=near)
        return self._dense(a.grey, grey, start, fine=fine, near=near)

    def _free(self, a: FlowFrame, b: FlowFrame) -> Array:
        """Flow a -> b without geometry: the motion filter's, where it made b a keyframe."""
        flow = self._full.get((a.key, b.key))
        return self._search(a, b) if flow is None else flow

    def _moved(
        self, a: FlowFrame, b: FlowFrame, search: Callable[[FlowFrame, FlowFrame], Array]
    ) -> Array:
        """Displacement [h,w,2] px at the cells."""
        key = (a.key, b.key)
        known = self._grid.get(key)
        if known is not None:
            return known
        moved = sample(search(a, b), a.centres)
        self._grid.put(key, moved)
        return moved

    def one_way(self, a: FlowFrame, b: FlowFrame) -> Edge:
        """Edge a -> b without the way back, exact at full size."""
        found = self._moved(a, b, self._search)
        gain = self._checks.gain(a, b, found)
        grey = as_bright(b.grey, gain)
        moved = polished(a.grey, grey, a.centres, found, self.options.fill_window)
        return self._checks.one_way(a, b, moved, gain)

    def one_way_again(self, a: FlowFrame, b: FlowFrame, edge: Edge, start: Array | None) -> Edge:
        """Edge a -> b once more, by windows of `b` as it looks through what is predicted.

        Args:
            edge: what was found. start: targets [h,w,2] that are predicted, cells; None: unknown.
        """
        if start is None or not self.options.warp or self.options.fill_window < SMALLEST:
            return edge
        before = self._raster.moved(edge.target, a)
        gain = self._checks.gain(a, b, before)
        expected = self._raster.dense(start, a, settled=True, curved=self.options.curved).flow
        there = self._raster.pixels(*a.grey.shape) + expected
        seen = seen_through(as_bright(b.grey, gain), there)
        window = self.options.fill_window
        moved = polished_through(a.grey, seen, a.centres, before, expected, window)
        return self._checks.one_way(a, b, moved, gain)

    def both_ways(
        self,
        a: FlowFrame,
        b: FlowFrame,
        start_ab: Array | None,
        start_ba: Array | None,
        fine: bool = False,
        *,
        bridged: tuple[FlowFrame, FlowFrame],
        seeded: bool = False,
    ) -> tuple[Edge, Edge]:
        """Edges a -> b and b -> a, each checked against the other.

        What was found without about the same cells, from about the same start, is kept; what was
        searched from nearly the same one is searched again as `again_coarsest` says.

        Args:
            a, b: frames. start_ab, start_ba: targets [h,w,2] to start from; None: free.
            fine: as for global adjustment.
            bridged: both without what moves, or as they are; what is found there counts if surer.
            seeded: whether another search sets out from points matched by their descriptors.
        """
        key, starts = (a.key, b.key, fine, seeded), (start_ab, start_ba)
        known, change = self._pairs.get(key), self.options.bridge_change
        if known and set_out_from(known, starts) and taken_out_alike(known, bridged, change):
            return replace(known[0]), replace(known[1])
        near = False
        if self.options.again_coarsest < _ALL_LEVELS:
            before = known or self._pairs.get((a.key, b.key, fine, not seeded))
            near = before is not None and set_out_from(before, starts, _NEAR_START)
        both = self._searched((a, b), bridged, starts, fine, seeded, near)
        self._pairs.put(key, both)
        return replace(both[0]), replace(both[1])

    def _searched(
        self,
        frames: tuple[FlowFrame, FlowFrame],
        bridged: tuple[FlowFrame, FlowFrame],
        starts: tuple[Array | None, Array | None],
        fine: bool,
        seeded: bool,
        near: bool,
    ) -> tuple[Edge, Edge]:
        """Edges there and back, as of `both_ways`, by a search of the pictures.

        Args:
            near: they were searched before from about these starts.
        """
        a, b = bridged
        whole = None if a.bridged is b.bridged is None else self._whole(frames, starts, fine, near)
        flows = self._both_started(bridged, starts, fine, near)
        both = self._checks.edges(bridged, self._checks.found(bridged, flows, starts))
        if whole is not None:
            there, back = self._checks.edges(bridged, whole)
            share = self.options.bridged_share
            both = surer(there, both[0], a.bridged, share), surer(back, both[1], b.bridged, share)
        if seeded:
            seeds = self._seeds.between(*frames, a.bridged, b.bridged)
            both = self._seeded(seeds, bridged, flows, both, fine)
        return replace(both[0], bridged=a.bridged), replace(both[1], bridged=b.bridged)

    def _whole(
        self,
        frames: tuple[FlowFrame, FlowFrame],
        starts: tuple[Array | None, Array | None],
        fine: bool,
        near: bool,
    ) -> tuple[Found, Found]:
        """What a search there and back between whole pictures comes to at the cells.

        It is kept: what is bridged changes with every look at what moves, and this does not.
        """
        a, b = frames
        key = (a.key, b.key, fine)
        known = self._plain.get(key)
        if known is not None and set_out_from(known, starts):
            return known
        flows = self._both_started(frames, starts, fine, near)
        found = self._checks.found(frames, flows, starts)
        if not self.options.turn_reach:  # with the flow itself it would be too large
            self._plain.put(key, found)
        return found

    def _seeded(
        self,
        seeds: Seeds,
        frames: tuple[FlowFrame, FlowFrame],
        flows: tuple[Array, Array],
        edges: tuple[Edge, Edge],
        fine: bool,
    ) -> tuple[Edge, Edge]:
        """The edges, with surer matches of a search that sets out from the seeds.

        Args:
            frames: without what moves. flows: dense flow between them, there and back.
        """
        if not len(seeds):
            return edges
        a, b = frames
        (ab, off), (ba, missed) = drawn(flows[0], seeds), drawn(flows[1], seeds.turned())
        if not (np.maximum(off, missed) > _SEEDED).any():
            return edges
        ab, ba = self._search(a, b, ab, fine, near=True), self._search(b, a, ba, fine, near=True)
        starts = edges[0].started, edges[1].started
        there, back = self._checks.edges(frames, self._checks.found(frames, (ab, ba), starts))
        return (
            surer(edges[0], there, a.bridged, clearly=_CLEARLY),
            surer(edges[1], back, b.bridged, clearly=_CLEARLY),
        )

    def _both_started(
        self,
        frames: tuple[FlowFrame, FlowFrame],
        starts: tuple[Array | None, Array | None],
        fine: bool,
        near: bool,
    ) -> tuple[Array, Array]:
        """Dense flow there and back from these targets."""
        (a, b), (start_ab, start_ba) = frames, starts
        return self._started(a, b, start_ab, fine, near), self._started(b, a, start_ba, fine, near)

    def _started(
        self, a: FlowFrame, b: FlowFrame, start: Array | None, fine: bool, near: bool
    ) -> Array:
        """Dense flow a -> b from these targets; without, as the motion filter searches."""
        if start is not None:
            warped = fine and self.options.warp
            expected = self._raster.dense(start, a, settled=warped, curved=self.options.curved)
            near = near and warped
            return self._search(a, b, expected.flow, fine, near, warped, expected.bend)
        if a.bridged is None and b.bridged is None:
            return self._free(a, b)
        return self._search(a, b, None, fine)

    def begin(self, pairs: Iterable[tuple[FlowFrame, FlowFrame, bool]], fine: bool) -> None:
        """Begin a round of searches `both_ways`: of these frames, and whether they are seeded."""
        asked = [(a.key, b.key, fine, seeded) for a, b, seeded in pairs]
        self._pairs.begin(asked)
        self._plain.begin([key[:3] for key in asked])

    def settle(self) -> None:
        """End a round of searches: pairs of long ago are given up."""
        self._pairs.settle()
        self._plain.settle()

    def map(self, jobs: list[Callable[[], Any]]) -> list[Any]:
        """Run jobs on the pool, results in order."""
        if len(jobs) < 2:
            return [job() for job in jobs]
        return list(self._pool.map(lambda job: job(), jobs))
