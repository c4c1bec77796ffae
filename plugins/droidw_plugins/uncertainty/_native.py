"""The costly parts of the objective, compiled for this processor at first use.

`_objective` is the reference, and takes their place where there is no compiler.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
from ctypes import c_double, c_float, c_int32, c_int64, c_void_p
from pathlib import Path

import torch
from torch import Tensor

from droidw.geometry.projective import NEAR
from droidw_plugins.bundle._build import BuildError, Recipe, build
from droidw_plugins.bundle._native_calls import native_recipe
from droidw_plugins.uncertainty._objective import EPSILON, Samples, motions, neighbours

__all__ = ["Kernels", "load_kernels"]

_VERSION = 1
_SOURCE = Path(__file__).with_name("csrc") / "consistency.cpp"
_log = logging.getLogger(__name__)


def load_kernels() -> Kernels | None:
    """The compiled kernels, or None, with a line in the log, where they cannot be made."""
    try:
        return Kernels()
    except BuildError as error:
        _log.info("uncertainty runs in torch: %s", error)
        return None


class Kernels:
    """The loaded library; all tensors are float32 on the CPU, indices int64.

    Raises:
        BuildError: there is no compiler, it failed, or the library cannot be loaded.
    """

    def __init__(self) -> None:
        model = native_recipe()
        if model is None:
            raise BuildError("no C++ compiler was found; install g++ or clang")
        digest = hashlib.sha256(_SOURCE.read_bytes()).hexdigest()
        recipe = Recipe(
            name="consistency",
            compiler=model.compiler,
            version=model.version,
            attempts=model.attempts,
            source=str(_SOURCE),
            target=f"{model.target} {digest}",
            advice="torch does the same without a compiler: uncertainty.options.kernels=torch",
        )
        path = build(recipe)
        try:
            library = ctypes.CDLL(str(path))
            library.dw_samples.restype = None
            library.dw_samples.argtypes = [
                c_int64, c_int64, c_int64, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p,
                c_float, c_int32, c_void_p, c_void_p, c_void_p, c_void_p,
            ]  # fmt: skip
            library.dw_similarity.restype = None
            library.dw_similarity.argtypes = [
                c_int64, c_int64, c_int64, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p,
                c_void_p, c_void_p, c_float, c_int32, c_void_p,
            ]  # fmt: skip
            library.dw_pair_gradient.restype = c_double
            library.dw_pair_gradient.argtypes = [c_int64, c_int64, *([c_void_p] * 7)]
            version = int(library.dw_consistency_version())
        except (OSError, AttributeError) as error:
            raise BuildError(
                f"{path} cannot be loaded ({error}); delete it to try again"
            ) from error
        if version != _VERSION:
            raise BuildError(f"{path} is of version {version}, not {_VERSION}; delete it")
        self._library = library

    def samples(
        self, T_cw: Tensor, disps: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, low: int
    ) -> Samples:
        """`_objective.project` and `make_samples` in one; rows of the stacks count from `low`."""
        edges, (height, width) = len(ii), disps.shape[1:]
        turn, shift = (part.float().contiguous() for part in motions(T_cw, intrinsics, ii, jj))
        disps, depth, goal = disps.contiguous(), ii.contiguous(), (jj - low).contiguous()
        cells = height * width
        place = disps.new_empty(edges, 2, cells)
        first = torch.empty(edges * cells, dtype=torch.int64)
        weights = disps.new_empty(4, edges * cells)
        inside = torch.empty(edges, cells, dtype=torch.bool)
        self._library.dw_samples(
            edges, height, width, turn.data_ptr(), shift.data_ptr(), disps.data_ptr(),
            depth.data_ptr(), goal.data_ptr(), NEAR, torch.get_num_threads(), place.data_ptr(),
            first.data_ptr(), weights.data_ptr(), inside.data_ptr(),
        )  # fmt: skip
        return Samples(ii - low, place, first, neighbours(height, width), weights, inside)

    def similarity(self, features: Tensor, samples: Samples, lengths: Tensor) -> Tensor:
        """`_objective.similarity`; 0 for cells that are not inside."""
        edges, cells = samples.inside.shape
        features, lengths = features.contiguous(), lengths.contiguous()
        source, first = samples.source.contiguous(), samples.first.contiguous()
        weights, inside = samples.weights.contiguous(), samples.inside.contiguous()
        out = features.new_empty(edges, cells)
        self._library.dw_similarity(
            edges, cells, features.shape[2], features.data_ptr(), lengths.data_ptr(),
            source.data_ptr(), first.data_ptr(), (c_int64 * 4)(*samples.steps),
            weights.data_ptr(), inside.data_ptr(), EPSILON, torch.get_num_threads(),
            out.data_ptr(),
        )  # fmt: skip
        return out

    def pair_gradient(self, u: Tensor, rho: Tensor, samples: Samples) -> tuple[Tensor, Tensor]:
        """`_objective.pair_gradient`, decoupled."""
        edges, cells = samples.inside.shape
        u, rho = u.contiguous(), rho.contiguous()
        source, first = samples.source.contiguous(), samples.first.contiguous()
        weights = samples.weights.contiguous()
        out = torch.zeros_like(u)
        energy = self._library.dw_pair_gradient(
            edges, cells, u.data_ptr(), rho.data_ptr(), source.data_ptr(), first.data_ptr(),
            (c_int64 * 4)(*samples.steps), weights.data_ptr(), out.data_ptr(),
        )  # fmt: skip
        return out, torch.tensor(energy)
