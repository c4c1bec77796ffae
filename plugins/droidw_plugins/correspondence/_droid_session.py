"""The edges of one factor graph, as correspondence `droid` keeps them (REFERENCE 1.4, 5.2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from droidw.geometry.projective import pixel_grid
from droidw.geometry.transfer import on_device
from droidw.interfaces.correspondence import EdgeRequest, EdgeUpdate, Purpose
from droidw_plugins.correspondence._droid_corr import Pyramid, lookup, lookup_lowmem, volume
from droidw_plugins.correspondence._droid_net import motion_features, upsample_convex

if TYPE_CHECKING:
    from droidw_plugins.correspondence._droid import DroidCorrespondence

__all__ = ["DroidSession"]

# Cells of all edges that go through the network at once; bounds memory, not the result.
_TOGETHER = {"cpu": 1 << 15, "cuda": 300_000}


@dataclass
class _Edge:
    """State of one edge: hidden state [128,h,w], last target [h,w,2], correlation or None."""

    net: Tensor
    target: Tensor
    volume: Tensor | None


@dataclass(frozen=True)
class _Sources:
    """What aggregation gives for some source frames."""

    damping: Tensor
    upmask: Tensor | None


class DroidSession:
    """Hidden state, target and correlation of edges, moved by one round at every `update`.

    Edges with the same source go through the network together: they share its context and are
    averaged for its damping.
    """

    def __init__(self, owner: DroidCorrespondence, purpose: Purpose) -> None:
        self._owner = owner
        self._purpose = purpose
        self._edges: dict[int, _Edge] = {}
        self._features: dict[int, Tensor] = {}
        mode = owner.options.correlation
        if mode == "auto":
            mode = "lowmem" if purpose == "global" else "auto"
        budget = {"auto": owner.options.volume_mb * 1e6, "volume": float("inf"), "lowmem": 0.0}
        self._room = budget[mode]

    @property
    def nbytes(self) -> int:
        """Bytes of all edges."""
        kept = [(e.net, e.target, e.volume) for e in self._edges.values()]
        return sum(t.nbytes for tensors in kept for t in tensors if t is not None)

    def forget(self, ids: list[int]) -> None:
        """Drop edges; unknown ids are ignored."""
        for name in ids:
            edge = self._edges.pop(name, None)
            if edge is not None and edge.volume is not None:
                self._room += edge.volume.nbytes

    @torch.no_grad()
    def update(self, request: EdgeRequest) -> EdgeUpdate:
        """One round of the update operator on all edges of the request."""
        target = torch.empty_like(request.coords, dtype=torch.float32)
        confidence = torch.empty_like(target)
        if not request.ids:
            return EdgeUpdate(target, confidence)
        found: list[_Sources] = []
        for rows in self._batches(request):
            at = on_device(rows, target.device)
            target[at], confidence[at], sources = self._round(request, rows, request.coords[at])
            if sources is not None:
                found.append(sources)
        if not found:
            return EdgeUpdate(target, confidence)
        masks = [s.upmask for s in found if s.upmask is not None]
        return EdgeUpdate(
            target,
            confidence,
            damping=torch.cat([s.damping for s in found]),
            sources=sorted(set(request.ii)),
            upmask=torch.cat(masks) if masks else None,
        )

    @torch.no_grad()
    def upsample(self, node: int, disp: Tensor) -> Tensor | None:
        """The map [h,w] of a source frame at full size [8h,8w], float32.

        By the mask of the last update; None for a frame that was no source then, or where the
        purpose is not "global".
        """
        features = self._features.get(node)
        if features is None:
            return None
        owner = self._owner
        with owner.computing():
            mask = owner.net.update.upmask(owner.working(features)[None])
        return upsample_convex(disp[None], mask, "zeros" if owner.published else "replicate")[0]

    # -- one round -------------------------------------------------------------------------

    def _batches(self, request: EdgeRequest) -> Iterator[list[int]]:
        """Rows in ascending order of their sources, all of a source in one batch."""
        height, width = request.coords.shape[1:3]
        device = "cuda" if request.coords.is_cuda else "cpu"
        most = max(1, _TOGETHER[device] // (height * width))
        order = sorted(range(len(request.ids)), key=lambda r: (request.ii[r], request.jj[r]))
        batch: list[int] = []
        for _, group in groupby(order, key=lambda r: request.ii[r]):
            rows = list(group)
            if batch and len(batch) + len(rows) > most:
                yield batch
                batch = []
            batch = batch + rows
        yield batch

    def _round(
        self, request: EdgeRequest, rows: Sequence[int], coords: Tensor
    ) -> tuple[Tensor, Tensor, _Sources | None]:
        """Targets, confidences, and what the sources get, of a batch."""
        owner, update = self._owner, self._owner.net.update
        edges = self._state(request, rows, coords)
        nodes = sorted({request.ii[r] for r in rows})
        row_of = {node: row for row, node in enumerate(nodes)}
        which = on_device([row_of[request.ii[r]] for r in rows], coords.device)
        height, width = coords.shape[1:3]
        grid = pixel_grid(height, width, device=coords.device)
        motion = motion_features(coords, torch.stack([e.target for e in edges]), grid)
        corr = self._correlation(request, rows, coords, edges)
        net = self._stack([e.net for e in edges])
        inp = self._stack([request.payload(node).inp for node in nodes])
        aggregate = self._purpose != "fill"
        with owner.computing():
            new = update(net, inp, corr, motion, which, aggregate)
        target = coords + new.delta
        nets = new.net.to(owner.stored)
        for edge, hidden, where in zip(edges, nets, target, strict=True):
            edge.net, edge.target = hidden, where
        if new.gathered is None:
            return target, new.weight, None
        return target, new.weight, self._aggregate(nodes, which, new.gathered)

    def _aggregate(self, nodes: list[int], which: Tensor, gathered: Tensor) -> _Sources:
        """Damping and mask of these sources from what their edges gathered."""
        owner, update = self._owner, self._owner.net.update
        # A product with shares, not a scattered sum: the same result every time on a GPU too.
        share = (which == torch.arange(len(nodes), device=which.device)[:, None]).float()
        share = share / share.sum(dim=1, keepdim=True)
        rows = gathered.permute(0, 2, 3, 1).flatten(1).float()
        mean = (share @ rows).view(-1, *gathered.shape[2:], 128).permute(0, 3, 1, 2)
        with owner.computing():
            features = update.features(mean)
            damping = update.damping(features)
            mask = update.upmask(features).float() if self._purpose == "window" else None
        if self._purpose == "global":
            for node, one in zip(nodes, features.to(owner.stored), strict=True):
                self._features[node] = one
        return _Sources(damping, mask)

    def _state(self, request: EdgeRequest, rows: Sequence[int], coords: Tensor) -> list[_Edge]:
        """The state of these edges; a new one starts from its source and the reprojection."""
        edges = []
        for row, start in zip(rows, coords, strict=True):
            name = request.ids[row]
            if name not in self._edges:
                net = request.payload(request.ii[row]).net
                self._edges[name] = _Edge(net, start.float(), None)
                self._edges[name].volume = self._volume(request, row)
            edges.append(self._edges[name])
        return edges

    def _volume(self, request: EdgeRequest, row: int) -> Tensor | None:
        """The correlation of a new edge, if there is room to keep it."""
        height, width = request.coords.shape[1:3]
        pyramid = Pyramid(height, width)
        owner = self._owner
        size = height * width * pyramid.columns * owner.stored.itemsize
        if size > self._room:
            return None
        self._room -= size
        i, j = request.payload(request.ii[row]), request.payload(request.jj[row])
        columns = pyramid.features(owner.working(j.fmap))
        return volume(owner.working(i.fmap), columns).to(owner.stored)

    def _correlation(
        self, request: EdgeRequest, rows: Sequence[int], coords: Tensor, edges: list[_Edge]
    ) -> Tensor:
        """Looked-up correlation [E,196,h,w] of a batch, from kept volumes and on the fly."""
        pyramid = Pyramid(*coords.shape[1:3])
        kept = [n for n, edge in enumerate(edges) if edge.volume is not None]
        volumes = [e.volume for e in edges if e.volume is not None]
        if len(kept) == len(edges):
            return lookup(volumes, coords, pyramid)
        fresh = [n for n, edge in enumerate(edges) if edge.volume is None]
        working, payload = self._owner.working, request.payload
        pooled: dict[int, Tensor] = {}
        for n in fresh:
            j = request.jj[rows[n]]
            if j not in pooled:
                pooled[j] = pyramid.features(working(payload(j).fmap))
        pairs = [
            (working(payload(request.ii[rows[n]]).fmap), pooled[request.jj[rows[n]]]) for n in fresh
        ]
        at = on_device(fresh, coords.device)
        corr = lookup_lowmem(pairs, coords[at], pyramid)
        if not kept:
            return corr
        both = corr.new_empty(len(edges), *corr.shape[1:])
        both[at] = corr
        at = on_device(kept, coords.device)
        both[at] = lookup(volumes, coords[at], pyramid)
        return both

    def _stack(self, maps: list[Tensor]) -> Tensor:
        stacked = self._owner.working(torch.stack(maps))
        return stacked.contiguous(memory_format=torch.channels_last)
