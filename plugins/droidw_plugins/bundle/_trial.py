"""Whether kernels that could be compiled can run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from droidw.geometry.projective import pixel_grid
from droidw.geometry.se3 import identity
from droidw.solve.problem import BAProblem

if TYPE_CHECKING:
    from droidw.interfaces.bundle import BundleAdjuster

__all__ = ["try_step"]


def try_step(backend: BundleAdjuster, device: torch.device) -> None:
    """One step on a tiny problem, so that kernels that compile but cannot run are found out now.

    Raises:
        RuntimeError: it did not end as it must.
    """
    T_cw = identity(2, device=device)
    T_cw[1, 0] = 0.1
    target = pixel_grid(4, 4, device=device)[None] + 0.05
    status = backend.step(
        BAProblem(
            T_cw=T_cw,
            disps=torch.ones(2, 4, 4, device=device),
            intrinsics=torch.tensor([4.0, 4.0, 1.5, 1.5], device=device),
            ii=torch.tensor([0], device=device),
            jj=torch.tensor([1], device=device),
            target=target,
            weight=torch.ones_like(target),
            fixed=torch.tensor([True, False], device=device),
            damping=torch.ones(2, 4, 4, device=device),
        )
    ).report.status
    if status != "ok":
        raise RuntimeError(f"a step of its kernels on a tiny problem ended with '{status}'")
