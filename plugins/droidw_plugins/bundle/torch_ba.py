"""Bundle adjustment backend `torch`: the reference implementation, and the one for a CPU."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.bundle import BundleAdjuster
    from droidw.solve.problem import BAProblem, Step

__all__ = ["COMPONENT", "TorchBundleAdjuster", "TorchBundleOptions"]


@dataclass(frozen=True)
class TorchBundleOptions:
    """Options of the `torch` backend."""

    chunk_cells: int = field(
        default=98304,
        metadata={"help": "cells worked on at a time; fewer need less memory and cache", "ge": 1},
    )
    halvings: int = field(
        default=4,
        metadata={"help": "how often a guarded step that raised the energy is halved", "ge": 0},
    )


class TorchBundleAdjuster:
    """Dense Gauss-Newton with per-cell depth elimination (REFERENCE 3; paper section on BA).

    Runs on the device and in the dtype of the problem's tensors; the reduced camera system is
    assembled and solved in float64. On a CPU the same input gives the same bytes as long as the
    number of threads stays the same.
    """

    def __init__(self, options: TorchBundleOptions | None = None) -> None:
        from droidw_plugins.bundle._layout import Workspace

        self._options = options or TorchBundleOptions()
        self._work = Workspace()

    def step(self, problem: BAProblem) -> Step:
        """One damped step; see `BAProblem` for the energy and `Report` for what may go wrong."""
        from droidw_plugins.bundle._gauss_newton import gauss_newton_step

        return gauss_newton_step(
            problem, self._work, self._options.chunk_cells, self._options.halvings
        )


def _build(options: TorchBundleOptions, context: BuildContext) -> BundleAdjuster:
    return TorchBundleAdjuster(options)


COMPONENT: Component[BundleAdjuster] = Component(
    name="torch",
    summary="dense Gauss-Newton with per-cell depth elimination, on CPU and GPU",
    factory=_build,
    options=TorchBundleOptions,
    capabilities=frozenset({"cpu", "cuda"}),
    reference="DROID-SLAM, Teed and Deng 2021, section 3.3; own code",
)
