"""The edges of one graph, measured by correspondence `flow`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from droidw.geometry.transfer import upload
from droidw.interfaces.correspondence import EdgeRequest, EdgeUpdate
from droidw_plugins.correspondence._flow_mask import bridge
from droidw_plugins.correspondence._flow_types import Array, Edge, FlowFrame

if TYPE_CHECKING:
    from droidw_plugins.correspondence._flow import FlowCorrespondence

__all__ = ["FlowSession"]

# Share of the cells of an edge whose place in the other picture has to be predicted for a search to
# set out from that.
_KNOWN = 0.5


class FlowSession:
    """Edges measured once, and again when geometry says that the search went elsewhere."""

    def __init__(self, owner: FlowCorrespondence, *, one_way: bool, fine: bool) -> None:
        self._owner = owner
        self._one_way = one_way
        self._fine = fine
        self._edges: dict[int, Edge] = {}

    def forget(self, ids: list[int]) -> None:
        """Drop edges."""
        for edge_id in ids:
            self._edges.pop(edge_id, None)

    def update(self, request: EdgeRequest) -> EdgeUpdate:
        """Measure what is new or has moved away; return the state of all edges."""
        coords = request.coords.detach().cpu().numpy()
        new = [row for row, edge_id in enumerate(request.ids) if edge_id not in self._edges]
        wanted = {*new, *self._astray(request, coords)}
        blind = self._blind(request)
        bridged = self._bridged(request, sorted(wanted.union(blind)))
        wanted.update(row for row in blind if any(n in bridged for n in _ends(request, row)))
        if self._one_way:
            self._measure_one_way(request, wanted, coords)
        else:
            self._measure_pairs(request, sorted(wanted), coords, bridged)
        if not request.ids:
            none = torch.zeros_like(request.coords)
            return EdgeUpdate(none, none.new_zeros(*none.shape[:3], 3))
        edges = [self._edges[edge_id] for edge_id in request.ids]
        device = request.coords.device
        target = torch.from_numpy(np.stack([e.target for e in edges]))
        confidence = torch.from_numpy(np.stack([e.confidence for e in edges]))
        return EdgeUpdate(upload(target, device), upload(confidence, device))

    def _blind(self, request: EdgeRequest) -> list[int]:
        """Rows searched before geometry could be believed, once it and uncertainty can be.

        Without uncertainty a search that starts from poses which follow what moves would only
        confirm them.
        """
        if request.gates is None or not request.informed:
            return []
        known = [self._edges.get(edge_id) for edge_id in request.ids]
        return [row for row, edge in enumerate(known) if edge is not None and edge.blind]

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
        astray = []
        for row, edge in zip(rows, edges, strict=True):
            sure = np.maximum(edge.confidence[..., 0], edge.confidence[..., 1]) > 0.1
            away = np.abs(coords[row] - edge.target)
            far = sure & (np.maximum(away[..., 0], away[..., 1]) > opt.restart)
            known = np.count_nonzero(sure)
            if known < 0.02 * sure.size or np.count_nonzero(far) > known / 2:
                astray.append(row)
        return astray

    def _measure_one_way(self, request: EdgeRequest, new: set[int], coords: Array) -> None:
        """Search what is new, and see all else again through what is predicted by now."""
        starts = _predicted(request, coords)

        def job(row: int) -> Callable[[], Edge]:
            a, b = request.payload(request.ii[row]), request.payload(request.jj[row])
            if row in new:
                return lambda: self._owner.one_way(a, b)
            edge = self._edges[request.ids[row]]
            return lambda: self._owner.one_way_again(a, b, edge, starts[row])

        rows = range(len(request.ids))
        for row, edge in zip(rows, self._owner.map([job(r) for r in rows]), strict=True):
            self._edges[request.ids[row]] = edge

    def _measure_pairs(
        self,
        request: EdgeRequest,
        wanted: list[int],
        coords: Array,
        bridged: dict[int, FlowFrame],
    ) -> None:
        """One job per unordered pair, since the check needs both directions anyway.

        A direction that is not wanted sets out from its prediction too: from nowhere it would end
        elsewhere, and good matches of the other one would fail the check.
        """
        pairs: dict[tuple[int, int], dict[bool, int]] = {}
        for row in wanted:
            i, j = request.ii[row], request.jj[row]
            pairs.setdefault((min(i, j), max(i, j)), {})[i < j] = row

        ends = zip(request.ii, request.jj, strict=True)
        predicted = {end: row for row, end in enumerate(ends)}
        options = self._owner.options
        known = _predicted(request, coords) if wanted else []

        def start(row: int | None) -> Array | None:
            return None if row is None else known[row]

        asked: list[tuple[FlowFrame, FlowFrame, bool]] = []

        def job(key: tuple[int, int]) -> Callable[[], Any]:
            a, b = request.payload(key[0]), request.payload(key[1])
            starts = start(predicted.get(key)), start(predicted.get(key[::-1]))
            without = bridged.get(key[0], a), bridged.get(key[1], b)
            seeded = options.seeds > 0 and (
                request.doubtful or min(f.held for f in without) < options.seeds_below
            )
            asked.append((a, b, seeded))
            return lambda: self._owner.both_ways(
                a, b, *starts, self._fine, bridged=without, seeded=seeded
            )

        jobs = [job(key) for key in pairs]
        self._owner.begin(asked, self._fine)
        measured = self._owner.map(jobs)
        self._owner.settle()
        for rows, both in zip(pairs.values(), measured, strict=True):
            for forward, row in rows.items():
                edge = both[0 if forward else 1]
                old = self._edges.get(request.ids[row])
                edge.searches = old.searches + 1 if old and not old.blind else 1
                edge.blind = not request.informed
                self._edges[request.ids[row]] = edge

    def _bridged(self, request: EdgeRequest, rows: list[int]) -> dict[int, FlowFrame]:
        """By node: pictures of these edges with something to leave out, and without it."""
        options = self._owner.options
        if request.gates is None or not rows or options.bridge == 0:
            return {}
        nodes = sorted({node for row in rows for node in _ends(request, row)})
        gates = request.gates(nodes).cpu().numpy()
        frames = [request.payload(node) for node in nodes]
        jobs: list[Callable[[], Any]] = [
            partial(
                bridge, f, g, options.bridge, options.reach, options.blur, outline=options.outline
            )
            for f, g in zip(frames, gates, strict=True)
        ]
        made = zip(nodes, self._owner.map(jobs), strict=True)
        return {node: frame for node, frame in made if frame.bridged is not None}


def _ends(request: EdgeRequest, row: int) -> tuple[int, int]:
    """The nodes of an edge."""
    return request.ii[row], request.jj[row]


def _predicted(request: EdgeRequest, coords: Array) -> list[Array | None]:
    """Where poses and depths put the cells of edges, [h,w,2] cells each; None if hardly known."""
    if not request.informed:
        return [None] * len(coords)
    valid = request.valid.cpu().numpy()
    return [one if v.mean() > _KNOWN else None for one, v in zip(coords, valid, strict=True)]
