"""Bundle adjustment backend `auto`: the fastest one that can run here, by name in the log."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.errors import MissingRequirementError
from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.bundle import BundleAdjuster
    from droidw.solve.problem import BAProblem, Step

__all__ = ["COMPONENT", "AutoBundleAdjuster", "AutoBundleOptions"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class AutoBundleOptions:
    """Options of the choice `auto`."""

    halvings: int = field(
        default=4,
        metadata={"help": "how often a guarded step that raised the energy is halved", "ge": 0},
    )


class AutoBundleAdjuster:
    """A backend under the name of the choice.

    Attributes:
        chosen: name of the backend; the manifest of a run records it.
        reason: why, in one sentence.
    """

    def __init__(self, chosen: str, reason: str, backend: BundleAdjuster) -> None:
        self.chosen, self.reason, self._backend = chosen, reason, backend

    def step(self, problem: BAProblem) -> Step:
        """One damped step of the chosen backend."""
        return self._backend.step(problem)


def _build(options: AutoBundleOptions, context: BuildContext) -> BundleAdjuster:
    """`cuda` on a GPU and `native` on a CPU if their kernels can be compiled, else `torch`."""
    from droidw_plugins.bundle import cuda_ba, native_ba, torch_ba

    backend: BundleAdjuster
    chosen, kind = ("cuda", "GPU") if context.device.type == "cuda" else ("native", "processor")
    try:
        if f"ba/{chosen}" in context.disabled:
            raise MissingRequirementError(f"'{chosen}' is switched off by DROIDW_DISABLE_PLUGINS")
        if chosen == "cuda":
            made = cuda_ba.CudaBundleOptions(halvings=options.halvings)
            backend = cuda_ba.COMPONENT.factory(made, context)
        else:
            native = native_ba.NativeBundleOptions(halvings=options.halvings)
            backend = native_ba.COMPONENT.factory(native, context)
        _try(backend, context)
        reason = f"its kernels are compiled for this {kind}"
    except (MissingRequirementError, RuntimeError) as error:
        chosen, reason = "torch", str(error)
        backend = torch_ba.TorchBundleAdjuster(
            torch_ba.TorchBundleOptions(halvings=options.halvings)
        )
    _log.info("ba: auto takes '%s': %s", chosen, reason)
    return AutoBundleAdjuster(chosen, reason, backend)


def _try(backend: BundleAdjuster, context: BuildContext) -> None:
    """One step on a tiny problem, so that kernels that compile but cannot run are found out now.

    Raises:
        RuntimeError: it did not end as it must.
    """
    import torch

    from droidw.geometry.projective import pixel_grid
    from droidw.geometry.se3 import identity
    from droidw.solve.problem import BAProblem

    device = context.device
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


COMPONENT: Component[BundleAdjuster] = Component(
    name="auto",
    summary="the fastest backend that can run here; the log and the manifest say which",
    factory=_build,
    options=AutoBundleOptions,
    capabilities=frozenset({"cpu", "cuda"}),
    reference="DROID-SLAM, Teed and Deng 2021, section 3.3; own code",
)
