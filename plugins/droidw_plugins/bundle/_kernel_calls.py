"""The GPU kernels through ctypes: building, loading, launching.

The same sources make a library that runs the kernels' threads in a loop on a CPU ("host"), so that
all but the launches themselves is tested on machines without a GPU.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from ctypes import c_char_p, c_double, c_int32, c_int64, c_void_p
from pathlib import Path
from typing import ClassVar

import torch

from droidw_plugins.bundle._build import BuildError, Recipe, build, compiler_version
from droidw_plugins.bundle._native_calls import native_recipe

__all__ = [
    "PREBUILT_VARIABLE",
    "Consistency",
    "Job",
    "KernelLibrary",
    "Pairs",
    "Parameters",
    "cuda_flags",
    "cuda_recipe",
    "host_recipe",
    "known_architectures",
    "nvcc_path",
    "prebuilt",
]

PREBUILT_VARIABLE = "DROIDW_CUDA_KERNELS"
"""A library made beforehand, taken before any other."""

_VERSION = 2
_NVCC_FLAGS = ("-std=c++17", "-O3", "-shared", "-Xcompiler", "-fPIC")
OLDEST, NEWEST = 75, 121
"""Compute capabilities, times ten, that the kernels are made for."""


class Job(ctypes.Structure):
    """`dw::Job` of csrc/job.h."""

    _fields_: ClassVar = [
        (name, kind)
        for kind, names in (
            (
                c_int64,
                "frames edges height width sources pairs blocks chunk chunks stride channels",
            ),
            (c_void_p, "T_cw disps intrinsics target weight damping prior fixed"),
            (c_double, "prior_weight lm ep huber min_disp max_disp floor scale"),
            (c_int64, "motion_only check"),
            (c_void_p, "order ii jj edge_source source_frame source_start source_active"),
            (c_void_p, "pair_start pair_a pair_b frame_source in_start in_edges diagonal"),
            (c_void_p, "block_row block_col block_at part_start part"),
            (c_void_p, "motions adjoints edge_part edge_sums pair_part pair_sums turned own"),
            (c_void_p, "system g least dx rounded E curvature gradient Q rhs steps"),
            (c_void_p, "free flags energy_part T_out disps_out told"),
            (c_void_p, "given_ii given_jj held_ii held_jj factor info"),
        )
        for name in names.split()
    ]


class Pairs(ctypes.Structure):
    """`dw::Pairs` of csrc/view_kernels.h."""

    _fields_: ClassVar = [
        *((name, c_int64) for name in ("frames", "edges", "height", "width", "chunk", "chunks")),
        *((name, c_void_p) for name in ("T_cw", "disps", "intrinsics", "ii", "jj")),
        *((name, c_void_p) for name in ("rounded", "part")),
        ("reach", c_int64),
        ("threshold", c_double),
        ("views", c_void_p),
    ]


class Consistency(ctypes.Structure):
    """`dw::Consistency` of csrc/view_kernels.h."""

    _fields_: ClassVar = [
        *((name, c_int64) for name in ("frames", "edges", "cells", "chunk", "chunks")),
        *((name, c_void_p) for name in ("u", "rho", "weights", "first")),
        ("steps", c_int64 * 4),
        *((name, c_void_p) for name in ("source_start", "source_edges", "source")),
        *((name, c_void_p) for name in ("here", "there", "part", "scale", "sums", "gradient")),
    ]


class Parameters(ctypes.Structure):
    """`dw::Parameters` of csrc/view_kernels.h."""

    _fields_: ClassVar = [
        *((name, c_int64) for name in ("rows", "channels", "chunk", "chunks")),
        *((name, c_void_p) for name in ("weight", "table", "part")),
    ]


def nvcc_path() -> str:
    """The CUDA compiler: on PATH, below `$CUDA_HOME`, or where it is installed; else ""."""
    found = shutil.which("nvcc")
    if found:
        return found
    for folder in (os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH"), "/usr/local/cuda"):
        if folder:
            found = shutil.which("nvcc", path=str(Path(folder) / "bin"))
            if found:
                return found
    return ""


def prebuilt() -> Path | None:
    """The library that `DROIDW_CUDA_KERNELS` names, or None."""
    named = os.environ.get(PREBUILT_VARIABLE)
    return Path(named).expanduser() if named else None


def known_architectures(nvcc: str) -> list[int]:
    """Compute capabilities, times ten, that this nvcc can compile for, as far as we care."""
    try:
        done = subprocess.run(
            [nvcc, "--list-gpu-code"], capture_output=True, text=True, check=False, timeout=60
        )
    except (OSError, subprocess.TimeoutExpired):
        return []  # to compile with it will say why
    digits = [line.partition("sm_")[2] for line in done.stdout.split()]
    return sorted({int(d) for d in digits if d.isdigit() and OLDEST <= int(d) <= NEWEST})


def cuda_flags(architecture: int) -> tuple[str, ...]:
    """Flags that make machine code for one capability and keep its PTX for later ones."""
    return (
        *_NVCC_FLAGS,
        f"-gencode=arch=compute_{architecture},code=[sm_{architecture},compute_{architecture}]",
    )


def cuda_recipe(device: torch.device | None = None) -> Recipe | None:
    """How the kernels are compiled for a GPU, by default the current one; None without nvcc."""
    nvcc = nvcc_path()
    if not nvcc:
        return None
    major, minor = torch.cuda.get_device_capability(device)
    wanted = 10 * major + minor
    known = [a for a in known_architectures(nvcc) if a <= wanted]
    chosen = max(known, default=wanted)
    return Recipe(
        name="cuda",
        compiler=nvcc,
        version=compiler_version(nvcc),
        attempts=(cuda_flags(chosen),),
        source="cuda.cu",
        target=f"sm_{chosen}",
        advice="the torch backend does the same on the GPU without a compiler: ba=torch",
    )


def host_recipe() -> Recipe | None:
    """How the same kernels are compiled as a plain loop for a CPU; None without a compiler."""
    native = native_recipe()
    if native is None:
        return None
    return Recipe(
        name="host",
        compiler=native.compiler,
        version=native.version,
        attempts=(("-std=c++17", "-O1", "-shared", "-fPIC"),),
        source="host.cpp",
        target="any",
        advice="see its message",
    )


class KernelLibrary:
    """The loaded kernels, for a GPU or as a plain loop.

    Args:
        path: of the library.

    Raises:
        BuildError: it cannot be loaded, or is of another version.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._library = ctypes.CDLL(str(path))
            self._library.dw_error_text.restype = c_char_p
            version = int(self._library.dw_kernels_version())
        except (OSError, AttributeError) as error:
            raise BuildError(
                f"{path} cannot be loaded ({error}); delete it to try again"
            ) from error
        if version != _VERSION:
            raise BuildError(f"{path} is of version {version}, not {_VERSION}; delete it")

    @classmethod
    def for_cuda(cls, device: torch.device | None = None) -> KernelLibrary:
        """The kernels for a GPU: a library made beforehand, else from the cache, else compiled.

        Raises:
            BuildError: there is no GPU, no nvcc, or it failed.
        """
        if not torch.cuda.is_available():
            raise BuildError("torch sees no GPU; run on the CPU: device=cpu")
        made = prebuilt()
        if made is not None:
            if not made.is_file():
                raise BuildError(
                    f"{PREBUILT_VARIABLE} names {made}, which is no file; name one, or unset it"
                )
            return cls(made)
        recipe = cuda_recipe(device)
        if recipe is None:
            raise BuildError(
                "no nvcc was found (looked on PATH, in $CUDA_HOME and /usr/local/cuda); install "
                "the CUDA toolkit, or use ba=torch, which runs on the GPU as well"
            )
        return cls(build(recipe))

    @classmethod
    def for_host(cls) -> KernelLibrary:
        """The kernels as a plain loop on a CPU, for tests.

        Raises:
            BuildError: there is no C++ compiler, or it failed.
        """
        recipe = host_recipe()
        if recipe is None:
            raise BuildError("no C++ compiler was found; install g++ or clang")
        return cls(build(recipe))

    def call(
        self,
        name: str,
        job: ctypes.Structure,
        dtype: torch.dtype,
        device: torch.device,
        pointers: Sequence[int] = (),
    ) -> None:
        """Launches `dw_<name>` on the device's current stream.

        Args:
            name: of the launcher. job: its structure. pointers: what it takes beside it.
            dtype: float32 or float64.
            device: of the tensors behind the pointers.

        Raises:
            RuntimeError: a launch failed.
        """
        launcher = getattr(self._library, f"dw_{name}")
        size = c_int32(8 if dtype == torch.float64 else 4)
        more = [c_void_p(p) for p in pointers]
        if device.type != "cuda":
            code = launcher(ctypes.byref(job), *more, size, None)
        else:
            with torch.cuda.device(device):
                index = torch.cuda.current_device()
                stream = torch.cuda.current_stream(device).cuda_stream
                code = self._library.dw_use_device(c_int32(index))
                code = code or launcher(ctypes.byref(job), *more, size, c_void_p(stream))
        if code:
            said = self._library.dw_error_text(c_int32(code)).decode()
            raise RuntimeError(f"the CUDA kernels of '{name}' failed: {said} (error {code})")
