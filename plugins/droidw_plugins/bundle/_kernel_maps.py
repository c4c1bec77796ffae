"""The map kernels on a GPU (or, in tests, their threads in a loop), through ctypes."""

from __future__ import annotations

from ctypes import c_int64

import torch
from torch import Tensor

from droidw_plugins.bundle._kernel_calls import Consistency, KernelLibrary, Pairs, Parameters
from droidw_plugins.bundle._kernel_step import CHUNK, chunks_of
from droidw_plugins.bundle.maps import Sampled, finish_distance

__all__ = ["KernelMaps"]

# Bits of a fixed-point number below the largest one that is spread: sums of up to 2^22 of them fit.
_BITS = 40


class KernelMaps:
    """See `droidw_plugins.bundle.maps.MapKernels`.

    Args:
        library: the kernels.
    """

    def __init__(self, library: KernelLibrary) -> None:
        self._library = library

    def pair_gradient(self, u: Tensor, rho: Tensor, samples: Sampled) -> tuple[Tensor, Tensor]:
        """See `MapKernels.pair_gradient`.

        What is spread onto neighbours is added up as integers, so that no order can matter.
        """
        frames, cells = u.shape
        edges = samples.source.shape[0]
        u, rho = u.contiguous(), rho.to(u).contiguous()
        weights, first = samples.weights.to(u).contiguous(), samples.first.long().contiguous()
        source = samples.source.long().contiguous()
        order = source.argsort(stable=True)
        starts = torch.searchsorted(source[order], torch.arange(frames + 1, device=u.device))
        here, there, gradient = torch.empty_like(rho), torch.empty_like(rho), torch.empty_like(u)
        part = torch.empty(edges * chunks_of(cells), dtype=torch.float64, device=u.device)
        sums = torch.zeros(frames, cells, dtype=torch.int64, device=u.device)
        job = Consistency(
            frames, edges, cells, CHUNK, chunks_of(cells), u.data_ptr(), rho.data_ptr(),
            weights.data_ptr(), first.data_ptr(), (c_int64 * 4)(*samples.steps),
            starts.data_ptr(), order.data_ptr(), source.data_ptr(), here.data_ptr(),
            there.data_ptr(), part.data_ptr(), None, sums.data_ptr(), gradient.data_ptr(),
        )  # fmt: skip
        self._library.call("pair_values", job, u.dtype, u.device)
        # the power of two that brings the largest value to `_BITS` bits, without asking for it
        largest = torch.cat((there.flatten().double(), part.new_ones(1) * 1e-300)).abs().amax()
        scale = torch.exp2(_BITS - torch.frexp(largest).exponent.double()).reshape(1)
        job.scale = scale.data_ptr()
        self._library.call("pair_gradient", job, u.dtype, u.device)
        return gradient, part.sum().to(u.dtype)

    def parameter_gradient(self, weight: Tensor, rows: Tensor) -> Tensor:
        """`sum_m weight[m] [rows[m], 1]`, [C+1]: the gradient of a map linear in its rows.

        Args:
            weight: [M]. rows: [M,C].
        """
        count, channels = rows.shape
        weight, rows = weight.to(rows).contiguous(), rows.contiguous()
        chunks = chunks_of(count)
        part = torch.empty(channels + 1, chunks, dtype=torch.float64, device=rows.device)
        job = Parameters(
            count, channels, CHUNK, chunks, weight.data_ptr(), rows.data_ptr(), part.data_ptr()
        )
        self._library.call("parameter_gradient", job, rows.dtype, rows.device)
        return part.sum(1).to(rows.dtype)

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
        ii, jj = ii.long().contiguous(), jj.long().contiguous()
        disps, edges, chunks = disps.contiguous(), ii.shape[0], chunks_of(h * w)
        T_cw, intrinsics = T_cw.to(disps).contiguous(), intrinsics.to(disps).contiguous()
        rounded = disps.new_empty(edges, 12)
        part = torch.empty(edges, chunks, 4, dtype=torch.float64, device=disps.device)
        job = Pairs(
            n, edges, h, w, CHUNK, chunks, T_cw.data_ptr(), disps.data_ptr(),
            intrinsics.data_ptr(), ii.data_ptr(), jj.data_ptr(), rounded.data_ptr(),
            part.data_ptr(),
        )  # fmt: skip
        self._library.call("frame_distance", job, disps.dtype, disps.device)
        return finish_distance(part.sum(1), h * w, beta, bidirectional).to(disps.dtype)

    def confirmed_views(
        self,
        T_cw: Tensor,
        disps: Tensor,
        intrinsics: Tensor,
        threshold: float,
        reach: int = 3,
    ) -> Tensor:
        """How many of the `reach` keyframes on either side confirm a depth, [N,h,w] int32.

        A neighbour does if the depth that the cell would have there and the depth at one of the
        four cells around the place differ by less than `threshold`, as a share (REFERENCE 5.9).
        """
        n, h, w = disps.shape
        disps = disps.contiguous()
        T_cw, intrinsics = T_cw.to(disps).contiguous(), intrinsics.to(disps).contiguous()
        views = torch.zeros(n, h, w, dtype=torch.int32, device=disps.device)
        job = Pairs(
            n, 0, h, w, CHUNK, 1, T_cw.data_ptr(), disps.data_ptr(), intrinsics.data_ptr(),
            reach=reach, threshold=threshold, views=views.data_ptr(),
        )  # fmt: skip
        self._library.call("confirmed_views", job, disps.dtype, disps.device)
        return views
