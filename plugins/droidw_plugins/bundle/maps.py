"""Kernels beside the step, for parts that work on whole maps: similarity, data term, distances.

`map_kernels(device)` gives those that can run there, or None; torch does the same without them. The
data term is that of `droidw_plugins.uncertainty._objective`, whose samples it takes as they are.
"""

from __future__ import annotations

import logging
from typing import Protocol

import torch
from torch import Tensor

__all__ = ["MapKernels", "Sampled", "finish_distance", "map_kernels"]

_log = logging.getLogger(__name__)


class Sampled(Protocol):
    """Where the cells of E frames fall in others; `_objective.Samples` is one.

    Attributes:
        source: [E] frame of the cells, row of a stack [K,P].
        first: [E*P] upper left of the four neighbours, row of a table [K*P].
        steps: from there to each of the four. weights: [4,E*P].
    """

    @property
    def source(self) -> Tensor: ...  # noqa: D102
    @property
    def first(self) -> Tensor: ...  # noqa: D102
    @property
    def steps(self) -> tuple[int, int, int, int]: ...  # noqa: D102
    @property
    def weights(self) -> Tensor: ...  # noqa: D102


class MapKernels(Protocol):
    """What both kinds of kernels do; the same input gives the same bytes."""

    def pair_gradient(self, u: Tensor, rho: Tensor, samples: Sampled) -> tuple[Tensor, Tensor]:
        """Gradient [K,P] of `sum rho / (u_i u_ij)` with respect to u [K,P], and the sum."""
        ...

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
        """What `droidw.geometry.projective.frame_distance` gives, [E]."""
        ...


def map_kernels(device: torch.device) -> MapKernels | None:
    """The kernels for a device, compiled now if they are not in the cache; None where none can run.

    What is missing is said in the log at the level of details.
    """
    from droidw_plugins.bundle._build import BuildError

    try:
        if device.type == "cuda":
            from droidw_plugins.bundle._kernel_calls import KernelLibrary
            from droidw_plugins.bundle._kernel_maps import KernelMaps

            return KernelMaps(KernelLibrary.for_cuda(device))
        from droidw_plugins.bundle._native_maps import NativeMaps

        return NativeMaps()
    except BuildError as error:
        _log.debug("no map kernels: %s", error)
        return None


def finish_distance(sums: Tensor, cells: int, beta: float, bidirectional: bool) -> Tensor:
    """Frame distances [E] from flow lengths and numbers of cells (REFERENCE 5.5).

    Args:
        sums: [E,4] of the full motion, then of its translation; [2E,4] if `bidirectional`, the
            way back behind the way there.
        cells: of a frame. beta: share of the full motion.
    """
    from droidw.geometry.projective import FAR_DISTANCE

    share = (beta * sums[:, 1] + (1.0 - beta) * sums[:, 3]) / cells
    mean = (beta * sums[:, 0] + (1.0 - beta) * sums[:, 2]) / cells / share.clamp_min(0.75)
    far = torch.full_like(mean, FAR_DISTANCE)
    out = torch.where(share < 0.75, far, mean)
    if not bidirectional:
        return out
    half = out.shape[0] // 2
    return 0.5 * (out[:half] + out[half:])
