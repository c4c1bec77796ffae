"""What keyframes see through: cells before which, as it seems, others see something.

What goes ahead of a camera at a steady distance looks like something far away, with matches, poses
and depths that agree. But when the camera comes to where it was there is a road, nearer than what
it seemed to be: from there on earlier keyframes saw through what stands still.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch.nn import functional as F

from droidw.geometry.projective import depth_there, reproject
from droidw.solve.weights import CLOSED

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.graph.factors import FactorGraph
    from droidw.graph.store import KeyframeStore

__all__ = ["evidence", "moves_ahead", "open_though_seen_through", "seen_through"]

# A point lies before a cell if it is nearer than anything around it by this factor, and is what is
# seen there within the other one.
_BEFORE, _SAME = 1.25, 1.1
# Of what moves ahead more than half is seen through by points three times as near, too; of what a
# path that is off in scale has in the wrong place a fifth.
_FAR_BEFORE, _MOST = 3.0, 0.4
# So many points that are seen in the right place are supposed of every cell.
_DOUBT = 2.0
# What is left of it where a match leads to.
_CARRIED = 0.95
_ROUNDS, _SETTLED = 60, 1e-3
# Share from which it counts, and uncertainty of something seen through wholly: alone, a third of
# the points that fall on a cell close it.
_FROM, _GAIN = 0.1, 4.0
# Share above which a cell is seen through.
_SEEN = 0.3
# Keyframes that look at another one at most, evenly spread: they bound time, and are enough to say.
_MOST_VIEWS = 256
# Pairs of keyframes that are held against each other at once; bounds memory, not the result.
_CHUNK = 512


def moves_ahead(
    store: KeyframeStore, graph: FactorGraph, gates: Tensor, least: float
) -> Tensor | None:
    """What is seen through, [N,h,w], if that is because something moves ahead of the camera.

    Args:
        store, graph, gates: as of `seen_through`.
        least: share of all cells that has to be open though others see through it.
    """
    through = seen_through(store, graph, gates)
    share = open_though_seen_through(through, gates)
    if share < least:
        return None
    far = seen_through(store, graph, gates, _FAR_BEFORE)
    return through if open_though_seen_through(far, gates) >= _MOST * share else None


def seen_through(
    store: KeyframeStore, graph: FactorGraph, gates: Tensor, before: float = _BEFORE
) -> Tensor:
    """How much each cell is seen through, [N,h,w] in [0,1].

    Of the well-known points of other keyframes that fall on a cell, the share that is nearer than
    anything that the cell or its neighbours could be; less where the cell itself is hardly known,
    since it may be anywhere then. It is carried on along matches, to where nothing passes a thing
    any more: by poses and depths instead, it would spread over what stands still beside it.

    Args:
        store: poses and depths, once they are mended.
        graph: its active edges, with what was measured last.
        gates: [N,h,w] in [0,1]; closed cells say nothing of others.
        before: how many times nearer a point has to be.
    """
    rows = graph.select()
    ii, jj = graph.index(rows)
    target, confidence = graph.target[rows], graph.confidence[rows][..., :2]
    measured = torch.isfinite(torch.cat([target, confidence], -1)).all(-1)
    sure = torch.where(measured, confidence.amin(-1), 0.0)
    known = _known(torch.where(measured, confidence.sum(-1), 0.0), ii, len(store))
    good = (gates >= CLOSED) & (known >= 1.0)
    share = _share_before(store, good, before) * known.clamp_max(1.0)
    share = F.avg_pool2d(share[:, None], 3, 1, 1, count_include_pad=False)[:, 0]
    return _carried_on(share, ii, jj, torch.where(measured[..., None], target, 0.0), sure)


def open_though_seen_through(through: Tensor, gates: Tensor) -> float:
    """Share of all cells that are open though others see through them.

    Args:
        through: [N,h,w] of `seen_through`. gates: [N,h,w] in [0,1].
    """
    return float(((through > _SEEN) & (gates >= CLOSED)).float().mean())


def evidence(through: Tensor) -> Tensor:
    """What is added to the uncertainty of cells that are seen through so much, any shape."""
    return _GAIN * (through - _FROM).clamp_min(0.0)


def _known(measured: Tensor, ii: Tensor, count: int) -> Tensor:
    """How much is known of each cell, [N,h,w], in units of the median of its keyframe.

    Args:
        measured: [E,h,w] information of the match of each cell of keyframe ii [E].
    """
    total = measured.new_zeros(count, *measured.shape[1:]).index_add_(0, ii, measured)
    usual = total.flatten(1).median(dim=1).values
    return total / usual.clamp_min(1e-9)[:, None, None]


def _share_before(store: KeyframeStore, good: Tensor, times: float) -> Tensor:
    """Share of the good points of all other keyframes that pass before a cell, [N,h,w].

    Args:
        good: bool [N,h,w]. times: nearer than the cell.
    """
    count, height, width = good.shape
    cells, device = height * width, good.device
    largest = F.max_pool2d(store.disps[:, None], 3, 1, 1).flatten()
    least = -F.max_pool2d(-store.disps[:, None], 3, 1, 1).flatten()
    before, same = (torch.zeros(count * cells, device=device) for _ in range(2))
    views = torch.arange(0, count, -(-count // _MOST_VIEWS), device=device)
    pairs = torch.cartesian_prod(views, torch.arange(count, device=device))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    for start in range(0, len(pairs), _CHUNK):
        ii, jj = pairs[start : start + _CHUNK].T
        coords, valid = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
        depth = depth_there(store.T_cw, store.disps, store.intrinsics, ii, jj)
        x, y = coords.round().long().unbind(-1)
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        falls = good[ii] & valid & inside  # what is valid lies ahead
        at = ((jj[:, None, None] * height + y) * width + x)[falls]
        disp = depth[falls].reciprocal()
        near, far = largest[at], least[at]
        before.index_add_(0, at, (disp > times * near).float())
        same.index_add_(0, at, ((disp < _SAME * near) & (disp > far / _SAME)).float())
    return (before / (before + same + _DOUBT)).view(good.shape)


def _carried_on(share: Tensor, ii: Tensor, jj: Tensor, target: Tensor, sure: Tensor) -> Tensor:
    """The larger of a share [N,h,w] and most of the mean where matches lead to, over and over.

    Args:
        target: [E,h,w,2] of edges ii [E] to jj [E], cells. sure: [E,h,w], what a match counts.
    """
    height, width = share.shape[1:]
    size = target.new_tensor([max(width - 1, 1), max(height - 1, 1)])
    where = target / size * 2 - 1
    total = torch.zeros_like(share).index_add_(0, ii, sure).clamp_min_(1e-9)
    found = share
    for _ in range(_ROUNDS):
        there = F.grid_sample(found[jj][:, None], where, align_corners=True)[:, 0]
        mean = torch.zeros_like(share).index_add_(0, ii, sure * there) / total
        more = torch.maximum(share, _CARRIED * mean)
        settled = float((more - found).abs().max()) < _SETTLED
        found = more
        if settled:
            break
    return found
