"""The CPU kernels through ctypes: building, loading, and one step."""

from __future__ import annotations

import ctypes
import math
import os
import platform
import weakref
from ctypes import POINTER, c_double, c_int32, c_int64, c_void_p
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from droidw.solve.problem import BAProblem, Report, Step
from droidw_plugins.bundle._build import (
    BuildError,
    Recipe,
    build,
    compiler_version,
    first_found,
)

__all__ = ["NativeKernels", "NativeLibraries", "native_recipe"]

_VERSION = 4
_STATUS = ("ok", "rejected", "singular", "nonfinite", "empty")
_COMPILERS = ("c++", "g++", "clang++")
_LAUNCHERS = ("ccache", "sccache", "distcc", "icecc")
_PLAIN = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")


class _Problem(ctypes.Structure):
    """`dw::Problem` of csrc/native_problem.h."""

    _fields_: ClassVar = [
        *((name, c_int64) for name in ("frames", "edges", "height", "width", "channels")),
        *((name, c_void_p) for name in ("ii", "jj", "T_cw", "disps", "target", "weight")),
        *((name, c_void_p) for name in ("damping", "prior", "fixed", "band", "band_rhs")),
        ("reach", c_int64),
        *((name, c_double) for name in ("fx", "fy", "cx", "cy")),
        *((name, c_double) for name in ("prior_weight", "lm", "ep", "huber")),
        *((name, c_double) for name in ("min_disp", "max_disp")),
        *((name, c_int32) for name in ("motion_only", "guard", "halvings", "threads")),
        *((name, c_void_p) for name in ("T_out", "disps_out", "isolated")),
    ]


class _Report(ctypes.Structure):
    """`dw::Report` of csrc/native_problem.h."""

    _fields_: ClassVar = [
        *((name, c_double) for name in ("cost_before", "cost_after", "step_norm")),
        *((name, c_int64) for name in ("dropped", "isolated")),
        *((name, c_int32) for name in ("status", "reserved")),
    ]


def native_recipe(dtype: torch.dtype = torch.float32) -> Recipe | None:
    """How the kernels are compiled for this processor; None without a C++ compiler.

    Args:
        dtype: of the numbers that they work on, float32 or float64.
    """
    # What makes a cache of compilers is none, and ours has no need of it.
    wanted = [word for word in os.environ.get("CXX", "").split() if word not in _LAUNCHERS]
    compiler = first_found([*wanted[:1], *_COMPILERS])
    if not compiler:
        return None
    tuned = ("-mcpu=native",) if platform.machine() in ("arm64", "aarch64") else ("-march=native",)
    double = dtype == torch.float64
    plain = (*_PLAIN, *(("-DDW_NUMBER=double",) if double else ()))
    return Recipe(
        name="native-float64" if double else "native",
        compiler=compiler,
        version=compiler_version(compiler),
        attempts=(
            (*plain, *tuned, "-fopenmp"),
            (*plain, *tuned),  # clang as Apple ships it has no OpenMP
            (*plain, "-fopenmp"),
            plain,
        ),
        source="native.cpp",
        target=_processor(),
        advice="the torch backend does the same without a compiler: ba=torch",
    )


def _processor() -> str:
    """What decides which instructions `-march=native` takes."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    wanted = ("flags", "model name", "Features", "CPU part")
    return " ".join(sorted({line for line in lines if line.startswith(wanted)}))


class NativeLibraries:
    """The library for float32, and that for float64 once it is asked for.

    Raises:
        BuildError: there is no compiler, it failed, or the library cannot be loaded.
    """

    def __init__(self) -> None:
        self._loaded = {torch.float32: _load(torch.float32)}

    def of(self, dtype: torch.dtype) -> ctypes.CDLL:
        """The library for numbers of this dtype, compiled now if it is not in the cache.

        Raises:
            BuildError: as above.
        """
        if dtype not in self._loaded:
            self._loaded[dtype] = _load(dtype)
        return self._loaded[dtype]


def _load(dtype: torch.dtype) -> ctypes.CDLL:
    recipe = native_recipe(dtype)
    if recipe is None:
        raise BuildError(
            f"no C++ compiler was found (looked for $CXX, {', '.join(_COMPILERS)}); install "
            "g++ or clang, or use ba=torch"
        )
    path = build(recipe)
    try:
        library = ctypes.CDLL(str(path))
        library.dw_native_open.restype = c_void_p
        library.dw_native_close.argtypes = [c_void_p]
        library.dw_native_close.restype = None
        library.dw_native_step.argtypes = [c_void_p, POINTER(_Problem), POINTER(_Report)]
        version = int(library.dw_native_version())
    except (OSError, AttributeError) as error:
        raise BuildError(f"{path} cannot be loaded ({error}); delete it to try again") from error
    if version != _VERSION:
        raise BuildError(f"{path} is of version {version}, not {_VERSION}; delete it")
    return library


class NativeKernels:
    """The kernels of a step, with scratch memory of their own.

    Raises:
        BuildError: as of `NativeLibraries`.
    """

    def __init__(self) -> None:
        self._libraries = NativeLibraries()
        self._work: dict[torch.dtype, int] = {}

    def _opened(self, dtype: torch.dtype) -> tuple[ctypes.CDLL, int]:
        """The library for these numbers, and its scratch memory."""
        library = self._libraries.of(dtype)
        if dtype not in self._work:
            work: int | None = library.dw_native_open()
            if not work:
                raise MemoryError("no memory for the kernels' workspace")
            weakref.finalize(self, library.dw_native_close, work)
            self._work[dtype] = work
        return library, self._work[dtype]

    def step(self, problem: BAProblem, threads: int, halvings: int) -> Step:
        """One step; `threads` at least 1.

        Raises:
            ValueError: an edge names a frame that does not exist, or shapes do not fit.
            MemoryError: there is not enough memory.
            BuildError: a problem is the first in float64, and that library cannot be made.
        """
        n, h, w = problem.disps.shape
        edges = problem.ii.shape[0]
        dtype = torch.float64 if problem.disps.dtype == torch.float64 else torch.float32
        _check(problem, n, edges, h, w)

        def ready(value: Tensor) -> Tensor:
            return value.to("cpu", dtype).contiguous()

        ii = problem.ii.to("cpu", torch.int64).contiguous()
        jj = problem.jj.to("cpu", torch.int64).contiguous()
        T_cw, disps = ready(problem.T_cw), ready(problem.disps)
        target, weight = ready(problem.target), ready(problem.weight)
        damping = ready(problem.damping)
        prior = None
        if problem.prior is not None and problem.prior_weight > 0:
            prior = ready(problem.prior)
        fixed = problem.fixed.to("cpu", torch.bool).contiguous()
        band = rhs = None
        if problem.pose_term is not None:
            term = problem.pose_term.to(torch.device("cpu"))
            band, rhs = term.band.contiguous(), term.rhs.contiguous()
        fx, fy, cx, cy = problem.intrinsics.tolist()
        T_out, disps_out = torch.empty_like(T_cw), torch.empty_like(disps)
        isolated = torch.empty(n, dtype=torch.int64)
        call = _Problem(
            n, edges, h, w, problem.channels,
            ii.data_ptr(), jj.data_ptr(), T_cw.data_ptr(), disps.data_ptr(),
            target.data_ptr(), weight.data_ptr(), damping.data_ptr(),
            None if prior is None else prior.data_ptr(), fixed.data_ptr(),
            None if band is None else band.data_ptr(), None if rhs is None else rhs.data_ptr(),
            -1 if band is None else band.shape[1] - 1,
            fx, fy, cx, cy,
            problem.prior_weight, problem.lm, problem.ep,
            -1.0 if problem.huber is None else problem.huber,
            problem.min_disp,
            float("inf") if problem.max_disp is None else problem.max_disp,
            problem.motion_only, problem.guard, halvings, threads,
            T_out.data_ptr(), disps_out.data_ptr(), isolated.data_ptr(),
        )  # fmt: skip
        told = _Report()
        library, work = self._opened(dtype)
        if library.dw_native_step(work, call, told):
            raise MemoryError(f"not enough memory for a step over {edges} edges of {h}x{w} cells")
        report = Report(
            _STATUS[told.status],  # type: ignore[arg-type]
            told.cost_before,
            # one and the same NaN, so that two reports without it are equal
            told.cost_after if problem.guard else math.nan,
            told.step_norm,
            told.dropped,
            tuple(isolated[: told.isolated].tolist()),
        )
        return Step(T_out.to(problem.T_cw), disps_out.to(problem.disps), report)


def _check(problem: BAProblem, n: int, edges: int, h: int, w: int) -> None:
    """What would make the kernels read beyond the tensors."""
    shapes = {
        "T_cw": (n, 7), "damping": (n, h, w), "fixed": (n,), "ii": (edges,), "jj": (edges,),
        "target": (edges, h, w, 2), "weight": (edges, h, w, problem.channels), "intrinsics": (4,),
    }  # fmt: skip
    if problem.prior is not None:
        shapes["prior"] = (n, h, w)
    if problem.pose_term is not None:
        problem.pose_term.check(n)
    for name, shape in shapes.items():
        found = tuple(getattr(problem, name).shape)
        if found != shape:
            raise ValueError(f"BAProblem.{name} has the shape {found}, not {shape}")
    for name, index in (("ii", problem.ii), ("jj", problem.jj)):
        if edges and (int(index.min()) < 0 or int(index.max()) >= n):
            raise ValueError(f"BAProblem.{name} names a frame outside 0..{n - 1}")
