"""The map kernels on a CPU, through ctypes."""

from __future__ import annotations

import ctypes
from ctypes import byref, c_double, c_int64, c_void_p
from typing import ClassVar

import torch
from torch import Tensor

from droidw_plugins.bundle._native_calls import NativeLibraries
from droidw_plugins.bundle.maps import Sampled, finish_distance

__all__ = ["NativeMaps"]


class _Samples(ctypes.Structure):
    """`dw::SampleJob` of csrc/native_views.h."""

    _fields_: ClassVar = [
        *((name, c_int64) for name in ("frames", "edges", "cells", "channels")),
        *((name, c_void_p) for name in ("source", "first")),
        ("steps", c_int64 * 4),
        *((name, c_void_p) for name in ("weights", "features", "lengths", "u", "rho")),
        *((name, c_void_p) for name in ("here", "there", "gradient", "cosine", "energy")),
        ("threads", c_int64),
    ]


class _Flow(ctypes.Structure):
    """`dw::FlowJob` of csrc/native_views.h."""

    _fields_: ClassVar = [
        *((name, c_int64) for name in ("edges", "height", "width")),
        *((name, c_void_p) for name in ("T_cw", "disps", "ii", "jj")),
        *((name, c_double) for name in ("fx", "fy", "cx", "cy")),
        ("sums", c_void_p),
        ("threads", c_int64),
    ]


class NativeMaps:
    """See `droidw_plugins.bundle.maps.MapKernels`; as many threads as torch has.

    Raises:
        BuildError: the kernels could not be compiled or loaded.
    """

    def __init__(self) -> None:
        self._libraries = NativeLibraries()

    def similarity(
        self, features: Tensor, samples: Sampled, lengths: Tensor | None = None
    ) -> Tensor:
        """What `droidw_plugins.uncertainty._objective.similarity` gives, [E,P].

        Args:
            features: [K,P,C], float32 or float64.
            samples: where the cells fall.
            lengths: [K,P] of the features, if they are known.
        """
        frames, cells, channels = features.shape
        edges = samples.source.shape[0]
        features = features.contiguous()
        if lengths is None:
            lengths = features.norm(dim=2)
        lengths = lengths.to(features).contiguous()
        cosine = features.new_empty(edges, cells)
        source, first, weights = _ready(samples, features, frames * cells)
        job = _Samples(
            frames, edges, cells, channels, source.data_ptr(), first.data_ptr(),
            (c_int64 * 4)(*samples.steps), weights.data_ptr(), features.data_ptr(),
            lengths.data_ptr(), cosine=cosine.data_ptr(), threads=torch.get_num_threads(),
        )  # fmt: skip
        self._libraries.of(features.dtype).dw_native_similarity(byref(job))
        return cosine

    def pair_gradient(self, u: Tensor, rho: Tensor, samples: Sampled) -> tuple[Tensor, Tensor]:
        """See `MapKernels.pair_gradient`."""
        frames, cells = u.shape
        edges = samples.source.shape[0]
        u, rho = u.contiguous(), rho.to(u).contiguous()
        here, there, gradient = torch.empty_like(rho), torch.empty_like(rho), torch.empty_like(u)
        energy = torch.empty(edges, dtype=torch.float64)
        source, first, weights = _ready(samples, u, frames * cells)
        job = _Samples(
            frames, edges, cells, 0, source.data_ptr(), first.data_ptr(),
            (c_int64 * 4)(*samples.steps), weights.data_ptr(), None, None, u.data_ptr(),
            rho.data_ptr(), here.data_ptr(), there.data_ptr(), gradient.data_ptr(), None,
            energy.data_ptr(), torch.get_num_threads(),
        )  # fmt: skip
        self._libraries.of(u.dtype).dw_native_data_term(byref(job))
        return gradient, energy.sum().to(u.dtype)

    def frame_distance(
        self,
        T_cw: Tensor,
        disps: Tensor,
        intrinsics: Tensor,
        ii: Tensor,
        jj: Tensor,
        beta: float,
        bidirectional: bool = True,
    ) -> Tensor:
        """See `MapKernels.frame_distance`."""
        n, h, w = disps.shape
        if bidirectional:
            ii, jj = torch.cat((ii, jj)), torch.cat((jj, ii))
        if (
            ii.numel()
            and not 0 <= int(torch.stack((ii, jj)).min()) <= int(torch.stack((ii, jj)).max()) < n
        ):
            raise ValueError(f"an edge names a frame outside 0..{n - 1}")
        ii, jj = ii.long().contiguous(), jj.long().contiguous()
        disps, T_cw = disps.contiguous(), T_cw.to(disps.dtype).contiguous()
        sums = torch.empty(ii.shape[0], 4, dtype=torch.float64)
        fx, fy, cx, cy = intrinsics.tolist()
        job = _Flow(
            ii.shape[0], h, w, T_cw.data_ptr(), disps.data_ptr(), ii.data_ptr(), jj.data_ptr(),
            fx, fy, cx, cy, sums.data_ptr(), torch.get_num_threads(),
        )  # fmt: skip
        self._libraries.of(disps.dtype).dw_native_flow(byref(job))
        return finish_distance(sums, h * w, beta, bidirectional).to(disps.dtype)


def _ready(samples: Sampled, like: Tensor, rows: int) -> tuple[Tensor, Tensor, Tensor]:
    """Source, first and weights as the kernels read them.

    Raises:
        ValueError: a sample lies outside the table.
    """
    first = samples.first.long().contiguous()
    if first.numel() and (int(first.min()) < 0 or int(first.max()) + samples.steps[3] >= rows):
        raise ValueError(f"a sample lies outside the table of {rows} rows")
    return samples.source.long().contiguous(), first, samples.weights.to(like).contiguous()
