"""Poses of frames against keyframes whose poses and depths stay: motion only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from droidw.geometry.projective import depth_there, reproject
from droidw.geometry.transfer import on_device
from droidw.interfaces.correspondence import EdgeRequest
from droidw.slam.contract import update_of
from droidw.slam.stepping import stepped
from droidw.solve.kernel import redescended, usual_square
from droidw.solve.problem import BAProblem
from droidw.solve.weights import residual_weights

if TYPE_CHECKING:
    from droidw.config.schema import SolverConfig
    from droidw.slam.optimise import Optimiser
    from droidw.solve.problem import PoseTerm

__all__ = ["carry_depth", "locate"]


def locate(
    optimiser: Optimiser,
    payloads: list[Any],
    start: Tensor,
    sources: list[list[int]],
    gates: Tensor,
    *,
    updates: int,
    iterations: int,
    solver: SolverConfig,
    label: str = "fill",
    known: Callable[[Tensor, float], PoseTerm | None] | None = None,
) -> Tensor:
    """Refine the poses of F frames against keyframes that see the same.

    Args:
        payloads: what correspondence keeps of each frame.
        start: [F,7] world to camera.
        sources: keyframes to measure each frame from.
        gates: [N,h,w] weights in [0,1] of all keyframes.
        updates, iterations: correspondence updates, and Gauss-Newton steps after each.
        label: under which the time is counted.
        known: poses [F,7] and the square of a usual residual -> what is known of the poses besides.
    Returns:
        [F,7]; the start where bundle adjustment could not move a frame.
    """
    store, weighting = optimiser.store, optimiser.weighting
    used = sorted({k for ks in sources for k in ks})
    local = {k: n for n, k in enumerate(used)}
    nodes = [store.payload(k) for k in used] + payloads
    pairs = [(local[k], len(used) + f) for f, ks in enumerate(sources) for k in ks]
    device = store.device
    sources_of, targets_of = [i for i, _ in pairs], [j for _, j in pairs]
    ii, jj = on_device(sources_of, device), on_device(targets_of, device)
    at = on_device(used, device)
    T_cw = torch.cat([store.T_cw[at], start])
    blank = store.disps.new_ones(len(payloads), *store.disps.shape[1:])
    disps = torch.cat([store.disps[at], blank])
    open_ = torch.cat([gates[at], blank])
    fixed = torch.arange(len(T_cw), device=device) < len(used)
    session = optimiser.parts.correspondence.session("fill")
    payload: Callable[[int], Any] = nodes.__getitem__
    for _ in range(updates):
        with optimiser.clock(f"{label}: reproject"):
            coords, valid = reproject(T_cw, disps, store.intrinsics, ii, jj)
        with optimiser.clock(f"{label}: correspondence"):
            ids = list(range(len(pairs)))
            request = EdgeRequest(ids, sources_of, targets_of, coords, valid, payload)
            answer = update_of(session.update(request), request)
        weight = residual_weights(
            answer.confidence,
            None,
            open_,
            ii,
            jj,
            answer.target,
            bidirectional=False,
            scale=weighting.confidence_scale,
        )
        with optimiser.clock(f"{label}: bundle"):
            for _ in range(iterations):
                problem = BAProblem(
                    T_cw=T_cw,
                    disps=disps,
                    intrinsics=store.intrinsics,
                    ii=ii,
                    jj=jj,
                    target=answer.target,
                    weight=weight,
                    fixed=fixed,
                    damping=torch.zeros_like(disps),
                    motion_only=True,
                    lm=solver.lm,
                    ep=solver.ep,
                    huber=solver.huber or None,
                    pairs=pairs,
                )
                # each frame has a kernel of its own width
                said = None if known is None else known(T_cw[len(used) :], usual_square(problem))
                if said is not None:
                    problem = replace(problem, pose_term=said.after(len(used)))
                problem = redescended(problem, solver, jj - len(used), len(payloads))
                step = stepped(optimiser.parts.ba, problem)
                optimiser.note(step.report)
                T_cw = step.T_cw
    return T_cw[len(used) :]


def carry_depth(disps: Tensor, T_cw: Tensor, intrinsics: Tensor) -> Tensor:
    """A depth map as it looks from another camera.

    Args:
        disps: [h,w] disparity of the first camera.
        T_cw: [2,7] poses of the first and of the other camera.
        intrinsics: [4] of the grid.
    Returns:
        [h,w] disparity of the other camera; of several cells that fall onto one the nearest
        counts, and where none falls, the mean of the neighbours is spread inwards.
    """
    height, width = disps.shape
    pair = torch.tensor([0, 1], device=disps.device)
    both = torch.stack([disps, disps])
    coords, valid = reproject(T_cw, both, intrinsics, pair[:1], pair[1:])
    there = depth_there(T_cw, both, intrinsics, pair[:1], pair[1:])[0].reciprocal()
    x, y = (coords[0] + 0.5).floor().long().unbind(-1)
    ok = valid[0] & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    flat = disps.new_zeros(height * width)
    flat.scatter_reduce_(0, (y * width + x)[ok], there[ok], "amax")
    carried = flat.view(height, width)
    known = (carried > 0).to(disps.dtype)
    if not bool(known.any()):
        return disps.clone()
    kernel = disps.new_ones(1, 1, 3, 3)
    for _ in range(height + width):
        if bool(known.all()):
            break
        total = torch.nn.functional.conv2d((carried * known)[None, None], kernel, padding=1)[0, 0]
        count = torch.nn.functional.conv2d(known[None, None], kernel, padding=1)[0, 0]
        carried = torch.where(known > 0, carried, total / count.clamp_min(1.0))
        known = (known + count).clamp_max(1.0)
    return carried
