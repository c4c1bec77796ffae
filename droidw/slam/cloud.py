"""Which depths several keyframes agree on, and the static point cloud made of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from droidw.geometry import se3
from droidw.geometry.projective import depth_there, reproject, viewing_rays
from droidw.slam.frame import CloudPoints

if TYPE_CHECKING:
    from droidw.config.schema import CloudConfig, DroidwConfig
    from droidw.graph.store import KeyframeStore

__all__ = ["confirmed", "consistent_depth", "static_cloud"]

# Neighbours on either side that a depth is compared with (REFERENCE 5.9, with the slip mended).
_REACH = 3


def consistent_depth(
    store: KeyframeStore,
    relative_threshold: float,
    min_views: int,
    min_disp: float,
    published: bool = False,
    measured: Tensor | None = None,
) -> Tensor:
    """Cells whose depth at least `min_views` neighbouring keyframes confirm, [N,h,w] bool.

    A neighbour confirms a cell if the depth that the cell would have there and the depth that
    the neighbour has at one of the four cells around it differ by less than
    `relative_threshold`, as a share of the depth.

    Args:
        published: compare with keyframes 3, 4 and 5 ahead instead of 1, 2 and 3, a slip of the
            published code (REFERENCE 5.9), under `compat: [droid-w]`.
        measured: [N,h,w] bool, cells whose matches had any weight; None: all. The others keep the
            depth that they began with, about which neighbours agree as well: they neither are
            confirmed nor confirm.
    """
    known = store.disps if measured is None else store.disps.masked_fill(~measured, torch.nan)
    count = len(store)
    height, width = store.grid.height, store.grid.width
    views = torch.zeros(count, height, width, dtype=torch.int64, device=store.device)
    ahead = range(_REACH, 2 * _REACH) if published else range(1, _REACH + 1)
    for gap in (*range(-_REACH, 0), *ahead):
        first, last = max(0, -gap), min(count, count - gap)
        if last <= first:
            continue
        ii = torch.arange(first, last, device=store.device)
        jj = ii + gap
        coords, valid = reproject(store.T_cw, store.disps, store.intrinsics, ii, jj)
        there = depth_there(store.T_cw, store.disps, store.intrinsics, ii, jj)
        x0, y0 = coords[..., 0].floor().long(), coords[..., 1].floor().long()
        agrees = torch.zeros_like(valid)
        for dx in (0, 1):
            for dy in (0, 1):
                x, y = x0 + dx, y0 + dy
                inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
                flat = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).flatten(1)
                seen = known[jj].flatten(1).gather(1, flat).view_as(there)
                agrees |= inside & ((there * seen - 1.0).abs() < relative_threshold)
        views[first:last] += (agrees & valid).long()
    # A disparity at its lower bound is no measurement, however many views share it.
    return (views >= min_views) & (known > 1.01 * min_disp)


def confirmed(store: KeyframeStore, config: DroidwConfig, weight: Tensor) -> Tensor:
    """`consistent_depth` as a run is configured; `weight` [N,h,w] are gates of the cells."""
    return consistent_depth(
        store,
        config.cloud.relative_threshold,
        config.cloud.min_views,
        config.weighting.min_disp,
        published="droid-w" in config.compat,
        measured=weight > 0,
    )


def static_cloud(
    store: KeyframeStore, valid: Tensor, weight: Tensor, options: CloudConfig
) -> CloudPoints:
    """Points of all confirmed, static, not too far cells in the world frame, coloured.

    Args:
        store: keyframes. valid: [N,h,w] of `consistent_depth`.
        weight: [N,h,w] in [0,1], what uncertainty left of the weight.
        options: thresholds.
    """
    if len(store) == 0:
        return CloudPoints(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    depth = 1.0 / store.disps
    keep = valid & (weight >= options.min_weight)
    if options.far > 0 and bool(keep.any()):
        keep &= depth < options.far * depth[keep].median()
    rays = viewing_rays(store.grid.height, store.grid.width, store.intrinsics)
    T_wc = se3.inv(store.T_cw)
    points = se3.act(T_wc[:, None], (rays[None] * depth[..., None]).flatten(1, 2))
    chosen = keep.flatten().nonzero()[:, 0]
    if len(chosen) > options.max_points:
        step = len(chosen) / options.max_points
        chosen = chosen[(torch.arange(options.max_points) * step).long()]
    xyz = points.reshape(-1, 3)[chosen].float().cpu().numpy()
    centres = store.grid.centres().round().long().numpy()
    rgb = np.stack([info.image[centres[..., 1], centres[..., 0]] for info in store.infos])
    return CloudPoints(xyz, rgb.reshape(-1, 3)[chosen.cpu().numpy()])
