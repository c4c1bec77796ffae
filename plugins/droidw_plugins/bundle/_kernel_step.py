"""One Gauss-Newton step by the GPU kernels, without a question to the device in between."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from droidw.solve.problem import BAProblem, Report, Step
from droidw_plugins.bundle._kernel_calls import Job, KernelLibrary
from droidw_plugins.bundle._kernel_layout import TILED_FROM, KernelLayout, make_kernel_layout
from droidw_plugins.bundle._kernel_solve import solve_dense, solve_tiled

__all__ = ["CHUNK", "KernelStepper", "chunks_of"]

CHUNK = 1024
"""Cells whose sums one block of threads makes."""

_EDGE_SUMS, _PAIR_SUMS, _FLAGS = 29, 42, 6
_BAD_SUMS, _CURVED, _PRIOR, _BAD_STEP, _OTHER_EDGES, _SINGULAR = range(_FLAGS)
_FLOOR = {torch.float32: 1e-5, torch.float64: 1e-11}
_GIVEN = ("T_cw", "disps", "intrinsics", "target", "weight", "damping", "fixed")


def chunks_of(cells: int) -> int:
    """Groups that `CHUNK` cuts this many cells into."""
    return max(1, -(-cells // CHUNK))


@dataclass(frozen=True)
class _Found:
    """What is read back from the device, once per step."""

    flags: tuple[bool, ...]
    energy: float
    dropped: int
    prior: float
    free: tuple[int, ...]
    norm: float


class _Scratch:
    """Memory of a step, and the job that points to it: made once for edges, grid and type.

    Holds no state that could change a result: everything is written before it is read.
    """

    def __init__(self, problem: BAProblem, layout: KernelLayout) -> None:
        n, h, w = problem.disps.shape
        e, cells, like = problem.ii.shape[0], h * w, problem.disps
        chunks = chunks_of(cells)
        depth = 0 if problem.motion_only else 1
        self.layout, self.key, self.pairs = layout, _key(problem), problem.pairs

        def full(*shape: int) -> Tensor:
            return torch.empty(*shape, dtype=torch.float64, device=like.device)

        def plain(*shape: int) -> Tensor:
            return like.new_empty(*shape)

        self.system, self.g, self.least = full(layout.system_size), full(6 * n), full(6 * n)
        self.told, self.moved = full(_FLAGS + 3 + 2 * n), plain(e, 12)
        self.flags = torch.zeros(_FLAGS, dtype=torch.int32, device=like.device)
        self.held: dict[str, Tensor] = {
            **layout.arrays, "held_ii": layout.ii, "held_jj": layout.jj,
            "system": self.system, "g": self.g, "least": self.least,
            "told": self.told, "flags": self.flags,
            "free": torch.zeros(n, dtype=torch.int32, device=like.device),
            "motions": full(e, 12), "adjoints": full(e, 36), "rounded": plain(e, 12),
            "edge_part": full(e * chunks, _EDGE_SUMS), "edge_sums": full(e, _EDGE_SUMS),
            "pair_part": full(depth * layout.pairs * chunks, _PAIR_SUMS),
            "pair_sums": full(layout.pairs, _PAIR_SUMS),
            "turned": full(e, 36), "own": full(layout.sources, 36),
            "E": plain(depth * e, 6, cells), "curvature": plain(depth * e, cells),
            "gradient": plain(depth * e, cells), "Q": plain(depth * layout.sources, cells),
            "rhs": plain(depth * layout.sources, cells), "steps": plain(e, 6),
            "energy_part": full((e + n) * chunks),
        }  # fmt: skip
        self.job = Job(
            frames=n, edges=e, height=h, width=w, sources=layout.sources, pairs=layout.pairs,
            blocks=layout.blocks, chunk=CHUNK, chunks=chunks, stride=layout.stride,
            motion_only=int(problem.motion_only), floor=_FLOOR[like.dtype],
            **{name: tensor.data_ptr() for name, tensor in self.held.items()},
        )  # fmt: skip


def _key(problem: BAProblem) -> tuple[Any, ...]:
    d = problem.disps
    return (d.shape, d.dtype, d.device, problem.ii.shape, problem.motion_only, _reach(problem))


def _reach(problem: BAProblem) -> int | None:
    """How far apart poses meet in the term of the poses; None without one."""
    return None if problem.pose_term is None else problem.pose_term.band.shape[1] - 1


class KernelStepper:
    """Runs steps with one library; keeps scratch memory and the order of the edges.

    The order is made on the host. Where a problem does not say its edges there (`pairs`), a step
    assumes that they are those of the step before as long as their number stays; the device
    compares them meanwhile, and the step is made again if it finds others. So one transfer at the
    end of the step is all that the host waits for.

    Args:
        library: the kernels.
        halvings: how often a guarded step that raised the energy is halved.
        tiled_from: keyframes from which on the system is kept in tiles.
    """

    def __init__(
        self, library: KernelLibrary, halvings: int = 4, tiled_from: int = TILED_FROM
    ) -> None:
        self._library, self._halvings, self._tiled_from = library, halvings, tiled_from
        self._scratch: _Scratch | None = None

    @torch.no_grad()
    def step(self, problem: BAProblem) -> Step:
        """One damped step; see `BAProblem` and `Report`.

        Raises:
            ValueError: an edge names a frame that does not exist, or shapes do not fit.
            RuntimeError: a launch failed.
        """
        problem = _ready(problem)
        scratch, fresh = self._prepared(problem)
        attempt = _Attempt(self._library, problem, scratch, check=False)
        found = attempt.run()
        if found.flags[_OTHER_EDGES] and not fresh:
            self._scratch = None
            scratch, _ = self._prepared(problem)
            attempt = _Attempt(self._library, problem, scratch, check=False)
            found = attempt.run()
        if found.flags[_BAD_SUMS]:
            attempt = _Attempt(self._library, problem, scratch, check=True)
            found = attempt.run()
            if found.flags[_BAD_SUMS]:
                report = Report("nonfinite", math.nan, dropped=found.dropped)
                return Step(problem.T_cw.clone(), problem.disps.clone(), report)
        return attempt.conclude(found, self._halvings)

    def _prepared(self, problem: BAProblem) -> tuple[_Scratch, bool]:
        """Scratch memory that fits, and whether its order was made for these very edges."""
        held, key = self._scratch, _key(problem)
        if held is not None and held.key == key and held.pairs == problem.pairs:
            return held, problem.pairs is not None
        frames = problem.disps.shape[0]
        layout = make_kernel_layout(
            problem.ii, problem.jj, frames, self._tiled_from, problem.edges(), _reach(problem)
        )
        self._scratch = None  # its memory first, so that both need not fit
        self._scratch = _Scratch(problem, layout)
        return self._scratch, True


class _Attempt:
    """One pass through the kernels with fixed assumptions."""

    def __init__(
        self, library: KernelLibrary, problem: BAProblem, scratch: _Scratch, check: bool
    ) -> None:
        self._library, self._scratch, self.problem = library, scratch, problem
        p, job = problem, scratch.job
        self.T_out, self.disps_out = torch.empty_like(p.T_cw), torch.empty_like(p.disps)
        prior = p.prior if p.prior_weight > 0 else None
        for name in _GIVEN:
            setattr(job, name, getattr(p, name).data_ptr())
        job.prior = None if prior is None else prior.data_ptr()
        job.given_ii, job.given_jj = p.ii.data_ptr(), p.jj.data_ptr()
        job.T_out, job.disps_out = self.T_out.data_ptr(), self.disps_out.data_ptr()
        job.prior_weight, job.lm, job.ep, job.scale = p.prior_weight, p.lm, p.ep, 1.0
        job.huber = -1.0 if p.huber is None else p.huber
        job.min_disp = p.min_disp
        job.max_disp = math.inf if p.max_disp is None else p.max_disp
        job.check, job.channels = int(check), p.channels

    def run(self) -> _Found:
        """All kernels of a full step, and one transfer."""
        s, n = self._scratch, self.problem.disps.shape[0]
        s.flags.zero_()
        s.system.zero_()
        self._call("system")
        if s.layout.band is not None:
            self._add_pose_term(s.layout.band)
        tiles = s.layout.tiles
        if tiles is None:
            dx, factor, info = solve_dense(s.system.view(6 * n, 6 * n), s.g)
            s.job.factor, s.job.info = factor.data_ptr(), info.data_ptr()
        else:
            stored = s.system.view(len(tiles.index), s.layout.stride, s.layout.stride)
            dx, solved = solve_tiled(stored, tiles, s.g, s.least)
            s.flags[_SINGULAR:].copy_(~solved)
            s.job.factor = None
        self._dx = dx.contiguous()
        s.job.dx = self._dx.data_ptr()
        self._call("finish")
        told = s.told.tolist()
        states = told[_FLAGS + 3 :]
        return _Found(
            flags=tuple(bool(x) for x in told[:_FLAGS]),
            energy=told[_FLAGS],
            dropped=int(told[_FLAGS + 1]) if math.isfinite(told[_FLAGS + 1]) else 0,
            prior=told[_FLAGS + 2],
            free=tuple(int(x) for x in states[:n]),
            norm=max(states[n:]),
        )

    def _add_pose_term(self, places: Tensor) -> None:
        """Adds the term of the poses, damped like the rest, to the system and its right side."""
        s, p, n = self._scratch, self.problem, self.problem.disps.shape[0]
        assert p.pose_term is not None
        moves = s.held["free"] == 1
        rhs = torch.where(moves[:, None], p.pose_term.rhs, 0.0)
        s.g += rhs.view(-1)
        blocks = p.pose_term.band.clone()
        blocks[:, 0].diagonal(dim1=-2, dim2=-1).mul_(1.0 + p.lm)
        before = torch.arange(n, device=moves.device)[:, None] - torch.arange(
            blocks.shape[1], device=moves.device
        )
        both = (before >= 0) & moves[:, None] & moves[before.clamp_min(0)]
        blocks = torch.where(both[..., None, None], blocks, 0.0)
        six = torch.arange(6, device=moves.device)
        at = places[..., None, None] + s.layout.stride * six[:, None] + six
        # blocks have places of their own; those that are left out add nothing to the first one
        s.system.index_add_(0, at.view(-1), blocks.view(-1))

    def conclude(self, found: _Found, halvings: int) -> Step:
        """The step, shortened if it is guarded and raised the energy, or the input again."""
        p = self.problem
        before = found.energy + p.prior_weight * found.prior  # the term of the poses is 0 there
        isolated = tuple(k for k, state in enumerate(found.free) if state < 0)
        report = Report("ok", before, dropped=found.dropped, isolated=isolated)
        moves = 1 in found.free
        if not moves and not (found.flags[_CURVED] or found.flags[_PRIOR]):
            return self._unchanged(replace(report, status="empty"))
        if found.flags[_SINGULAR]:
            return self._unchanged(replace(report, status="singular"))
        if found.flags[_BAD_STEP]:
            return self._unchanged(replace(report, status="nonfinite"))
        report = replace(report, step_norm=found.norm)
        if not p.guard:
            return Step(self.T_out, self.disps_out, report)
        for attempt in range(halvings + 1):
            scale = 0.5**attempt
            if attempt:
                self._scratch.job.scale = scale
                self._call("move")
            after = self._energy(scale)
            if after <= before:
                done = replace(report, step_norm=scale * found.norm, cost_after=after)
                return Step(self.T_out, self.disps_out, done)
        return self._unchanged(replace(report, status="rejected", step_norm=0.0, cost_after=before))

    def _energy(self, scale: float) -> float:
        """Energy of the state after a scaled step."""
        state = (self.T_out, self.disps_out, self._scratch.moved)
        self._call("energy", *(tensor.data_ptr() for tensor in state))
        energy, _, prior = self._scratch.told[_FLAGS : _FLAGS + 3].tolist()
        term = self.problem.pose_term
        known = 0.0 if term is None else float(term.energy(scale * self._dx.view(-1, 6)))
        return float(energy + self.problem.prior_weight * prior + known)

    def _unchanged(self, report: Report) -> Step:
        return Step(self.problem.T_cw.clone(), self.problem.disps.clone(), report)

    def _call(self, name: str, *pointers: int) -> None:
        disps = self.problem.disps
        self._library.call(name, self._scratch.job, disps.dtype, disps.device, pointers)


def _ready(problem: BAProblem) -> BAProblem:
    """The problem with contiguous tensors of one type, on one device; no copies where it is so."""
    dtype = torch.float64 if problem.disps.dtype == torch.float64 else torch.float32
    device = problem.disps.device
    n, h, w = problem.disps.shape
    edges = problem.ii.shape[0]
    shapes = {
        "T_cw": (n, 7), "disps": (n, h, w), "intrinsics": (4,), "target": (edges, h, w, 2),
        "weight": (edges, h, w, problem.channels), "damping": (n, h, w), "prior": (n, h, w),
    }  # fmt: skip
    ready: dict[str, Any] = {}
    for name, shape in shapes.items():
        value = getattr(problem, name)
        if value is None:
            continue
        if tuple(value.shape) != shape:
            raise ValueError(f"BAProblem.{name} has the shape {tuple(value.shape)}, not {shape}")
        ready[name] = value.to(device, dtype).contiguous()
    if problem.pose_term is not None:
        problem.pose_term.check(n)
        ready["pose_term"] = problem.pose_term.to(device)
    for name, kind in (("ii", torch.int64), ("jj", torch.int64), ("fixed", torch.bool)):
        ready[name] = getattr(problem, name).to(device, kind).contiguous()
    return replace(problem, **ready)
