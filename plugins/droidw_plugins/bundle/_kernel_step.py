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
from droidw_plugins.bundle._layout import Workspace

__all__ = ["CHUNK", "KernelStepper", "chunks_of"]

CHUNK = 1024
"""Cells whose sums one block of threads makes."""

_EDGE_SUMS, _PAIR_SUMS, _ENERGY = 29, 42, 27
_BAD_SUMS, _CURVED, _PRIOR, _BAD_STEP = range(4)
_FLOOR = {torch.float32: 1e-5, torch.float64: 1e-11}


def chunks_of(cells: int) -> int:
    """Groups that `CHUNK` cuts this many cells into."""
    return max(1, -(-cells // CHUNK))


@dataclass(frozen=True)
class _Found:
    """What is read back from the device, once per step."""

    same: bool
    flags: tuple[bool, ...]
    solved: bool
    energy: float
    dropped: int
    prior: float
    norm: float
    free: tuple[int, ...]


class KernelStepper:
    """Runs steps with one library; keeps scratch memory and the order of the edges.

    The order is made on the host. As long as the number of edges stays, a step assumes that the
    edges do, too; the device compares them meanwhile, and the step is made again if it finds
    others. So one transfer at the end of the step is all that the host waits for.

    Args:
        library: the kernels.
        halvings: how often a guarded step that raised the energy is halved.
        tiled_from: keyframes from which on the system is kept in tiles.
    """

    def __init__(
        self, library: KernelLibrary, halvings: int = 4, tiled_from: int = TILED_FROM
    ) -> None:
        self._library, self._halvings, self._tiled_from = library, halvings, tiled_from
        self._work = Workspace()
        self._layout: KernelLayout | None = None

    @torch.no_grad()
    def step(self, problem: BAProblem) -> Step:
        """One damped step; see `BAProblem` and `Report`.

        Raises:
            ValueError: an edge names a frame that does not exist.
            RuntimeError: a launch failed.
        """
        problem = _ready(problem)
        attempt = _Attempt(self, problem, self._held(problem), False)
        found = attempt.run()
        if not found.same:
            self._layout = None
            attempt = _Attempt(self, problem, self._held(problem), False)
            found = attempt.run()
        if found.flags[_BAD_SUMS]:
            attempt = _Attempt(self, problem, attempt.layout, True)
            found = attempt.run()
            if found.flags[_BAD_SUMS]:
                report = Report("nonfinite", math.nan, dropped=found.dropped)
                return Step(problem.T_cw.clone(), problem.disps.clone(), report)
        return attempt.conclude(found, self._halvings)

    def _held(self, problem: BAProblem) -> KernelLayout:
        held, frames = self._layout, problem.disps.shape[0]
        if (
            held is None
            or held.frames != frames
            or held.ii.shape != problem.ii.shape
            or held.ii.device != problem.ii.device
        ):
            held = make_kernel_layout(problem.ii, problem.jj, frames, self._tiled_from)
            self._layout = held
        return held


class _Attempt:
    """One pass through the kernels with fixed assumptions."""

    def __init__(
        self, stepper: KernelStepper, problem: BAProblem, layout: KernelLayout, check: bool
    ) -> None:
        self._library, self._work = stepper._library, stepper._work
        self.problem, self.layout = problem, layout
        self._prior = problem.prior is not None and problem.prior_weight > 0
        self._job = self._make_job(check)

    def _take(self, name: str, *shape: int, full: bool = False) -> Tensor:
        like = self._g if full else self.problem.disps
        return self._work.take(name, *shape, like=like)

    def _make_job(self, check: bool) -> Job:
        p, layout = self.problem, self.layout
        n, h, w = p.disps.shape
        e, cells = p.ii.shape[0], h * w
        chunks = chunks_of(cells)
        device = p.disps.device
        self._g = torch.empty(6 * n, dtype=torch.float64, device=device)
        self._flags = torch.zeros(4, dtype=torch.int32, device=device)
        self._free = torch.zeros(n, dtype=torch.int32, device=device)
        self._system = self._take("system", layout.system_size, full=True).zero_()
        self._least = self._take("least", 6 * n, full=True)
        self._edge_sums = self._take("edge_sums", e, _EDGE_SUMS, full=True)
        self._energy_part = self._take("energy_part", (e + n) * chunks, full=True)
        self._moved = self._take("moved", e, 12)
        self.T_out, self.disps_out = torch.empty_like(p.T_cw), torch.empty_like(p.disps)
        depth = 0 if p.motion_only else 1
        job = Job()
        sizes = {
            "frames": n, "edges": e, "height": h, "width": w, "sources": layout.sources,
            "pairs": layout.pairs, "blocks": layout.blocks, "chunk": CHUNK, "chunks": chunks,
            "stride": layout.stride, "motion_only": int(p.motion_only), "check": int(check),
        }  # fmt: skip
        options = {
            "prior_weight": p.prior_weight, "lm": p.lm, "ep": p.ep, "scale": 1.0,
            "huber": -1.0 if p.huber is None else p.huber, "min_disp": p.min_disp,
            "max_disp": math.inf if p.max_disp is None else p.max_disp,
            "floor": _FLOOR[p.disps.dtype],
        }  # fmt: skip
        tensors: dict[str, Tensor] = {
            "T_cw": p.T_cw, "disps": p.disps, "intrinsics": p.intrinsics, "target": p.target,
            "weight": p.weight, "damping": p.damping, "fixed": p.fixed, **layout.arrays,
            "motions": self._take("motions", e, 12, full=True),
            "adjoints": self._take("adjoints", e, 36, full=True),
            "edge_part": self._take("edge_part", e * chunks, _EDGE_SUMS, full=True),
            "edge_sums": self._edge_sums,
            "pair_part": self._take("pair_part", depth * layout.pairs * chunks, 42, full=True),
            "pair_sums": self._take("pair_sums", layout.pairs, _PAIR_SUMS, full=True),
            "turned": self._take("turned", e, 36, full=True),
            "own": self._take("own", layout.sources, 36, full=True),
            "system": self._system, "g": self._g, "least": self._least,
            "rounded": self._take("rounded", e, 12),
            "E": self._take("E", depth * e, 6, cells),
            "curvature": self._take("curvature", depth * e, cells),
            "gradient": self._take("gradient", depth * e, cells),
            "Q": self._take("Q", depth * layout.sources, cells),
            "rhs": self._take("rhs", depth * layout.sources, cells),
            "steps": self._take("steps", e, 6),
            "free": self._free, "flags": self._flags, "energy_part": self._energy_part,
            "T_out": self.T_out, "disps_out": self.disps_out,
        }  # fmt: skip
        if self._prior and p.prior is not None:
            tensors["prior"] = p.prior
        for name, number in {**sizes, **options}.items():
            setattr(job, name, number)
        for name, tensor in tensors.items():
            setattr(job, name, tensor.data_ptr())
        return job

    def run(self) -> _Found:
        """All kernels of a full step, and one transfer."""
        p, layout = self.problem, self.layout
        n = p.disps.shape[0]
        self._call("system")
        self._call("prior_energy", p.disps.data_ptr())
        prior = self._prior_sum()
        if layout.tiles is None:
            system = self._system.view(6 * n, 6 * n)
            dx, solved = solve_dense(system, self._g, self._least)
        else:
            tiles = self._system.view(len(layout.tiles.index), layout.stride, layout.stride)
            dx, solved = solve_tiled(tiles, layout.tiles, self._g, self._least)
        self._dx = dx.contiguous()
        self._job.dx = self._dx.data_ptr()
        if not p.motion_only:
            self._call("substitute")
        self._call("move")
        same = (p.ii == layout.ii).all() & (p.jj == layout.jj).all()
        told = torch.cat(
            [
                torch.stack([x.double() for x in (same, solved, prior)]),
                self._flags.double(),
                self._edge_sums[:, _ENERGY:].sum(0),  # energy, dropped measurements
                self._dx.view(n, 6).norm(dim=1).amax(0, keepdim=True),
                self._free.double(),
            ]
        ).tolist()
        return _Found(
            same=bool(told[0]),
            solved=bool(told[1]),
            prior=told[2],
            flags=tuple(bool(x) for x in told[3:7]),
            energy=told[7],
            dropped=int(told[8]) if math.isfinite(told[8]) else 0,
            norm=told[9],
            free=tuple(int(x) for x in told[10:]),
        )

    def conclude(self, found: _Found, halvings: int) -> Step:
        """The step, shortened if it is guarded and raised the energy, or the input again."""
        p = self.problem
        before = found.energy + p.prior_weight * found.prior
        isolated = tuple(k for k, state in enumerate(found.free) if state < 0)
        report = Report("ok", before, dropped=found.dropped, isolated=isolated)
        moves = 1 in found.free
        if not moves and not (found.flags[_CURVED] or found.flags[_PRIOR]):
            return self._unchanged(replace(report, status="empty"))
        if not found.solved:
            return self._unchanged(replace(report, status="singular"))
        if found.flags[_BAD_STEP]:
            return self._unchanged(replace(report, status="nonfinite"))
        report = replace(report, step_norm=found.norm)
        if not p.guard:
            return Step(self.T_out, self.disps_out, report)
        for attempt in range(halvings + 1):
            scale = 0.5**attempt
            if attempt:
                self._job.scale = scale
                self._call("move")
            after = self._energy()
            if after <= before:
                done = replace(report, step_norm=scale * found.norm, cost_after=after)
                return Step(self.T_out, self.disps_out, done)
        return self._unchanged(replace(report, status="rejected", step_norm=0.0, cost_after=before))

    def _energy(self) -> float:
        """Energy of the moved state."""
        p = self.problem
        moved = (self.T_out.data_ptr(), self.disps_out.data_ptr(), self._moved.data_ptr())
        self._call("energy", *moved)
        self._call("prior_energy", self.disps_out.data_ptr())
        measured = p.ii.shape[0] * self._job.chunks
        return float(self._energy_part[:measured].sum() + p.prior_weight * self._prior_sum())

    def _prior_sum(self) -> Tensor:
        if not self._prior or self.problem.motion_only:
            return self._g.new_zeros(())
        return self._energy_part[self.problem.ii.shape[0] * self._job.chunks :].sum()

    def _unchanged(self, report: Report) -> Step:
        return Step(self.problem.T_cw.clone(), self.problem.disps.clone(), report)

    def _call(self, name: str, *pointers: int) -> None:
        p = self.problem
        self._library.call(name, self._job, p.disps.dtype, p.disps.device, pointers)


def _ready(problem: BAProblem) -> BAProblem:
    """The problem with contiguous tensors of one type, on one device; no copies where it is so."""
    dtype = torch.float64 if problem.disps.dtype == torch.float64 else torch.float32
    device = problem.disps.device
    n, h, w = problem.disps.shape
    edges = problem.ii.shape[0]
    shapes = {
        "T_cw": (n, 7), "disps": (n, h, w), "intrinsics": (4,), "target": (edges, h, w, 2),
        "weight": (edges, h, w, 2), "damping": (n, h, w), "prior": (n, h, w),
    }  # fmt: skip
    ready: dict[str, Any] = {}
    for name, shape in shapes.items():
        value = getattr(problem, name)
        if value is None:
            continue
        if tuple(value.shape) != shape:
            raise ValueError(f"BAProblem.{name} has the shape {tuple(value.shape)}, not {shape}")
        ready[name] = value.to(device, dtype).contiguous()
    for name, kind in (("ii", torch.int64), ("jj", torch.int64), ("fixed", torch.bool)):
        ready[name] = getattr(problem, name).to(device, kind).contiguous()
    return replace(problem, **ready)
