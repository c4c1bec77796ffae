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
    from droidw_plugins.bundle._trial import try_step

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
        try_step(backend, context.device)
        reason = f"its kernels are compiled for this {kind}"
    except (MissingRequirementError, RuntimeError) as error:
        chosen, reason = "torch", str(error)
        backend = torch_ba.TorchBundleAdjuster(
            torch_ba.TorchBundleOptions(halvings=options.halvings)
        )
    _log.info("ba: auto takes '%s': %s", chosen, reason)
    return AutoBundleAdjuster(chosen, reason, backend)


COMPONENT: Component[BundleAdjuster] = Component(
    name="auto",
    summary="the fastest backend that can run here; the log and the manifest say which",
    factory=_build,
    options=AutoBundleOptions,
    capabilities=frozenset({"cpu", "cuda"}),
    reference="DROID-SLAM, Teed and Deng 2021, section 3.3; own code",
)
