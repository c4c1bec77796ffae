"""Implementation of correspondence `flow`."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from droidw.interfaces.correspondence import EdgeRequest, EdgeUpdate, Motion, Purpose

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid
    from droidw.slam.frame import Frame
    from droidw_plugins.correspondence.flow import FlowOptions

Array = npt.NDArray[np.float32]

# Flow fields kept at full size between the motion filter and the edges that want them.
_FULL_FIELDS = 24
# Grid flows kept for the filler: some ten kilobytes each.
_GRID_FIELDS = 20_000
# Median distance of two starts, in cells, that lead to the same result.
_SAME_START = 0.03
# Squared image derivative below which a window counts as flat, (grey levels / pixel)^2.
_FLAT = 0.1
# Checked pairs kept for the next session that asks for them: some forty kilobytes each.
_PAIRS = 4_000


@dataclass(frozen=True)
class FlowFrame:
    """Payload of one frame: grey image [H,W] uint8 and texture [h,w,2] at the cells.

    `texture` is the root mean square image derivative that fixes a match along x and along y,
    in grey levels per pixel, over the neighbourhood of a cell.
    """

    index: int
    grey: npt.NDArray[np.uint8]
    texture: Array
    centres: Array
    stride: int


@dataclass
class _Edge:
    """What is known of one directed edge: displacement and confidence on the grid."""

    target: Array
    confidence: Array
    started: Array | None
    searches: int = 1


class FlowCorrespondence:
    """Measures flow between pairs of frames with a small pool of threads."""

    def __init__(self, options: FlowOptions) -> None:
        self.options = options
        self.stride = options.stride
        self.offset = (options.stride - 1) / 2
        workers = options.workers or os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="flow")
        self._local = threading.local()
        self._lock = threading.Lock()
        self._full: OrderedDict[tuple[int, int], Array] = OrderedDict()
        self._grid: OrderedDict[tuple[int, int], tuple[Array, Array]] = OrderedDict()
        self._pairs: OrderedDict[tuple[int, int, bool], tuple[_Edge, _Edge]] = OrderedDict()

    def encode(self, frame: Frame, grid: Grid) -> FlowFrame:
        """Grey image and texture at the cells."""
        rgb = frame.image.permute(1, 2, 0).numpy()
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        centres = grid.centres().numpy().astype(np.float32)
        window = (2 * self.stride - 1, 2 * self.stride - 1)
        scaled = grey * np.float32(255.0)
        dx = cv2.Scharr(scaled, cv2.CV_32F, 1, 0, scale=1 / 32)
        dy = cv2.Scharr(scaled, cv2.CV_32F, 0, 1, scale=1 / 32)
        xx, yy, xy = (
            _at(cv2.blur(p, window, borderType=cv2.BORDER_REPLICATE), centres)
            for p in (dx * dx, dy * dy, dx * dy)
        )
        # What the window says of x once y is free, and the other way round: an oblique edge,
        # along which a match may slide, then counts for little in both.
        alone_x = xx - xy * xy / (yy + _FLAT)
        alone_y = yy - xy * xy / (xx + _FLAT)
        texture = np.sqrt(np.maximum(np.stack([alone_x, alone_y], -1), 0.0))
        grey8 = np.clip(scaled + 0.5, 0, 255).astype(np.uint8)
        return FlowFrame(frame.index, grey8, texture, centres, self.stride)

    def context(self, payload: FlowFrame, frame: Frame, grid: Grid) -> FlowFrame:
        """Nothing more is needed of a keyframe."""
        return payload

    def motion(self, reference: FlowFrame, current: FlowFrame) -> Motion:
        """Flow from the reference, judged by brightness agreement only."""
        if not (current.texture.max(axis=-1) > 0.5 * self.options.texture).any():
            return Motion(0.0, 0.0)  # a blank picture agrees with whatever is as bright
        moved, agrees = self._one_way(reference, current, self._forward)
        return self._motion(moved, agrees, reference)

    def session(self, purpose: Purpose = "window") -> _FlowSession:
        """Fresh edge state; flows already measured are shared between sessions."""
        return _FlowSession(self, one_way=purpose == "fill", fine=purpose == "global")

    # -- measuring -------------------------------------------------------------------------

    def _motion(self, moved: Array, agrees: Array, reference: FlowFrame) -> Motion:
        textured = reference.texture.max(axis=-1) > 0.5 * self.options.texture
        usable = textured & (agrees > 0.3)
        matched = float(usable.mean())
        if not usable.any():
            return Motion(0.0, 0.0)
        length = np.hypot(moved[..., 0], moved[..., 1])[usable]
        if (length < self.options.still).mean() > self.options.still_share:
            return Motion(float(np.median(length)) / self.stride, matched)
        return Motion(float(length.mean()) / self.stride, matched)

    def _search(
        self, a: FlowFrame, b: FlowFrame, start: Array | None = None, fine: bool = False
    ) -> Array:
        """Dense flow a -> b, [H,W,2] pixels; `fine` at the scale of global adjustment."""
        # An engine remembers that it was once given a start, and answers differently ever after:
        # one for each use, or the result would depend on which thread did what before.
        scale = self.options.global_scale if fine else self.options.finest_scale
        name = f"{'free' if start is None else 'started'}{scale}"
        engine: Any = getattr(self._local, name, None)
        if engine is None:
            engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
            engine.setFinestScale(scale)
            engine.setGradientDescentIterations(self.options.iterations)
            engine.setVariationalRefinementIterations(self.options.refinement)
            engine.setPatchSize(self.options.patch_size)
            engine.setPatchStride(self.options.patch_stride)
            setattr(self._local, name, engine)
        flow: Array = engine.calc(a.grey, b.grey, None if start is None else start.copy())
        return flow

    def _forward(self, a: FlowFrame, b: FlowFrame) -> Array:
        """Unstarted flow a -> b, remembered for a while."""
        key = (a.index, b.index)
        with self._lock:
            known = self._full.get(key)
        if known is not None:
            return known
        flow = self._search(a, b)
        with self._lock:
            self._full[key] = flow
            while len(self._full) > _FULL_FIELDS:
                self._full.popitem(last=False)
        return flow

    def _one_way(
        self, a: FlowFrame, b: FlowFrame, search: Callable[[FlowFrame, FlowFrame], Array]
    ) -> tuple[Array, Array]:
        """Displacement [h,w,2] px at the cells and brightness agreement [h,w] in [0,1]."""
        key = (a.index, b.index)
        with self._lock:
            known = self._grid.get(key)
        if known is not None:
            return known
        moved = _at(search(a, b), a.centres)
        agrees = self._agreement(a, b, moved)
        with self._lock:
            self._grid[key] = (moved, agrees)
            while len(self._grid) > _GRID_FIELDS:
                self._grid.popitem(last=False)
        return moved, agrees

    def _agreement(self, a: FlowFrame, b: FlowFrame, moved: Array) -> Array:
        """Agreement in brightness at both ends of the flow, and 0 outside the picture."""
        there = a.centres + moved
        height, width = a.grey.shape
        inside = (
            (there[..., 0] >= 0)
            & (there[..., 1] >= 0)
            & (there[..., 0] <= width - 1)
            & (there[..., 1] <= height - 1)
        )
        difference = np.abs(_at(a.grey, a.centres) - _at(b.grey, there))
        # A change of brightness by 10 grey levels is worth two pixels of position where the
        # picture is steep and says nothing where it is flat: texture decides there.
        tolerance = 6.0 + 1.5 * a.texture.max(axis=-1)
        agreement: Array = inside / (1.0 + (difference / tolerance) ** 2)
        return agreement.astype(np.float32)

    def one_way(self, a: FlowFrame, b: FlowFrame) -> _Edge:
        """Edge a -> b without the way back."""
        moved, agrees = self._one_way(a, b, self._search)
        confidence = agrees[..., None] * self._texture_weight(a)
        target = ((a.centres + moved - self.offset) / self.stride).astype(np.float32)
        return _Edge(target, confidence, None)

    def both_ways(
        self,
        a: FlowFrame,
        b: FlowFrame,
        start_ab: Array | None,
        start_ba: Array | None,
        fine: bool = False,
    ) -> tuple[_Edge, _Edge]:
        """Edges a -> b and b -> a, each checked against the other.

        What an earlier session found from about the same start is as good as a new search.
        """
        key = (a.index, b.index, fine)
        with self._lock:
            known = self._pairs.get(key)
        if known is not None and all(
            _close(edge.started, start)
            for edge, start in zip(known, (start_ab, start_ba), strict=True)
        ):
            return replace(known[0]), replace(known[1])
        if start_ab is None:
            ab = self._forward(a, b)
        else:
            ab = self._search(a, b, self._dense(start_ab, a), fine)
        if start_ba is None:
            ba = self._forward(b, a)
        else:
            ba = self._search(b, a, self._dense(start_ba, b), fine)
        both = self._checked(a, ab, ba, start_ab), self._checked(b, ba, ab, start_ba)
        with self._lock:
            self._pairs[key] = both
            while len(self._pairs) > _PAIRS:
                self._pairs.popitem(last=False)
        return replace(both[0]), replace(both[1])

    def _dense(self, target: Array, a: FlowFrame) -> Array:
        """Grid targets [h,w,2] in cells as a full flow field [H,W,2] in pixels."""
        flow = target * self.stride + self.offset - a.centres
        height, width = a.grey.shape
        rows = np.float32(np.clip((np.arange(height) - self.offset) / self.stride, 0, None))
        cols = np.float32(np.clip((np.arange(width) - self.offset) / self.stride, 0, None))
        map_x, map_y = np.meshgrid(cols, rows)
        dense = cv2.remap(
            np.ascontiguousarray(flow, dtype=np.float32),
            map_x,
            map_y,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        bounded: Array = np.clip(dense, -2.0 * width, 2.0 * width).astype(np.float32)
        return bounded

    def _checked(self, a: FlowFrame, ab: Array, ba: Array, started: Array | None) -> _Edge:
        moved = _at(ab, a.centres)
        there = a.centres + moved
        back = _at(ba, there, outside=1e4)
        error2 = ((moved + back) ** 2).sum(axis=-1)
        opt = self.options
        confidence = 1.0 / (1.0 + error2 / opt.consistency**2)
        confidence[error2 > opt.cutoff**2] = 0.0
        weight = confidence[..., None].astype(np.float32) * self._texture_weight(a)
        target = ((there - self.offset) / self.stride).astype(np.float32)
        return _Edge(target, weight, started)

    def _texture_weight(self, a: FlowFrame) -> Array:
        if self.options.texture <= 0:
            return np.ones_like(a.texture)
        t2 = a.texture**2
        weight: Array = t2 / (t2 + np.float32(self.options.texture**2))
        return weight

    def map(self, jobs: list[Callable[[], Any]]) -> list[Any]:
        """Run jobs on the pool, results in order."""
        if len(jobs) < 2:
            return [job() for job in jobs]
        return list(self._pool.map(lambda job: job(), jobs))


class _FlowSession:
    """Edges measured once, and again when geometry says that the search went elsewhere."""

    def __init__(self, owner: FlowCorrespondence, *, one_way: bool, fine: bool) -> None:
        self._owner = owner
        self._one_way = one_way
        self._fine = fine
        self._edges: dict[int, _Edge] = {}

    def forget(self, ids: list[int]) -> None:
        """Drop edges."""
        for edge_id in ids:
            self._edges.pop(edge_id, None)

    def update(self, request: EdgeRequest) -> EdgeUpdate:
        """Measure what is new or has moved away; return the state of all edges."""
        coords = request.coords.detach().cpu().numpy()
        new = [row for row, edge_id in enumerate(request.ids) if edge_id not in self._edges]
        wanted = sorted(new + self._astray(request, coords))
        if self._one_way:
            self._measure_one_way(request, wanted)
        else:
            self._measure_pairs(request, wanted, coords)
        if not request.ids:
            return EdgeUpdate(torch.zeros_like(request.coords), torch.zeros_like(request.coords))
        edges = [self._edges[edge_id] for edge_id in request.ids]
        device = request.coords.device
        target = torch.from_numpy(np.stack([e.target for e in edges])).to(device)
        confidence = torch.from_numpy(np.stack([e.confidence for e in edges])).to(device)
        return EdgeUpdate(target, confidence)

    def _astray(self, request: EdgeRequest, coords: Array) -> list[int]:
        """Rows where most confident cells lie far from the prediction of good geometry."""
        opt = self._owner.options
        if self._one_way or not request.informed:
            return []
        rows = [
            row
            for row, edge_id in enumerate(request.ids)
            if edge_id in self._edges and self._edges[edge_id].searches <= opt.restarts
        ]
        if not rows:
            return []
        edges = [self._edges[request.ids[row]] for row in rows]
        sure = np.stack([e.confidence.max(axis=-1) for e in edges]) > 0.1
        away = np.abs(coords[rows] - np.stack([e.target for e in edges])).max(axis=-1)
        known = sure.mean(axis=(1, 2))
        far = ((away > opt.restart) & sure).mean(axis=(1, 2))
        return [row for row, k, f in zip(rows, known, far, strict=True) if k < 0.02 or f > k / 2]

    def _measure_one_way(self, request: EdgeRequest, wanted: list[int]) -> None:
        def job(row: int) -> Callable[[], _Edge]:
            a, b = request.payload(request.ii[row]), request.payload(request.jj[row])
            return lambda: self._owner.one_way(a, b)

        for row, edge in zip(wanted, self._owner.map([job(r) for r in wanted]), strict=True):
            self._edges[request.ids[row]] = edge

    def _measure_pairs(self, request: EdgeRequest, wanted: list[int], coords: Array) -> None:
        """One job per unordered pair, since the check needs both directions anyway."""
        pairs: dict[tuple[int, int], dict[bool, int]] = {}
        for row in wanted:
            i, j = request.ii[row], request.jj[row]
            pairs.setdefault((min(i, j), max(i, j)), {})[i < j] = row

        def start(row: int | None) -> Array | None:
            if row is None or not request.informed:
                return None
            valid = request.valid[row].cpu().numpy()
            return coords[row] if valid.mean() > 0.5 else None

        def job(key: tuple[int, int], rows: dict[bool, int]) -> Callable[[], Any]:
            a, b = request.payload(key[0]), request.payload(key[1])
            starts = start(rows.get(True)), start(rows.get(False))
            return lambda: self._owner.both_ways(a, b, *starts, self._fine)

        measured = self._owner.map([job(key, rows) for key, rows in pairs.items()])
        for rows, both in zip(pairs.values(), measured, strict=True):
            for forward, row in rows.items():
                edge = both[0 if forward else 1]
                old = self._edges.get(request.ids[row])
                edge.searches = old.searches + 1 if old else 1
                self._edges[request.ids[row]] = edge


def _close(one: Array | None, other: Array | None) -> bool:
    """Whether two searches start from about the same place: both free, or within a pixel or so."""
    if one is None or other is None:
        return one is other
    return bool(np.median(np.abs(one - other)) < _SAME_START)


def _at(values: Any, points: Array, outside: float | None = None) -> Array:
    """Bilinear samples of [H,W(,C)] at points [h,w,2]; edge values (or `outside`) beyond."""
    mode = cv2.BORDER_REPLICATE if outside is None else cv2.BORDER_CONSTANT
    sampled = cv2.remap(
        values,
        np.ascontiguousarray(points[..., 0], dtype=np.float32),
        np.ascontiguousarray(points[..., 1], dtype=np.float32),
        cv2.INTER_LINEAR,
        borderMode=mode,
        borderValue=(outside or 0.0,) * 4,
    )
    result: Array = sampled.astype(np.float32, copy=False)
    return result
