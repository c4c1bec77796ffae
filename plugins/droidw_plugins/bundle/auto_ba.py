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
    """On a CPU `native` where a compiler is there, else `torch`."""
    from droidw_plugins.bundle import native_ba, torch_ba

    built: AutoBundleAdjuster | None = None
    if context.device.type == "cpu":
        try:
            backend = native_ba.COMPONENT.factory(
                native_ba.NativeBundleOptions(halvings=options.halvings), context
            )
            why = "compiled for this processor"
            built = AutoBundleAdjuster("native", why, backend)
        except MissingRequirementError as error:
            why = str(error)
    else:
        why = f"the one that runs on {context.device.type}"
    if built is None:
        backend = torch_ba.TorchBundleAdjuster(
            torch_ba.TorchBundleOptions(halvings=options.halvings)
        )
        built = AutoBundleAdjuster("torch", why, backend)
    _log.info("ba: auto takes '%s': %s", built.chosen, built.reason)
    return built


COMPONENT: Component[BundleAdjuster] = Component(
    name="auto",
    summary="the fastest backend that can run here; the log and the manifest say which",
    factory=_build,
    options=AutoBundleOptions,
    capabilities=frozenset({"cpu", "cuda"}),
)
