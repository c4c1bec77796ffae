"""Bundle adjustment backend `native`: the kernels compiled for this processor at first use."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.errors import MissingRequirementError
from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.bundle import BundleAdjuster
    from droidw.solve.problem import BAProblem, Step

__all__ = ["COMPONENT", "NativeBundleAdjuster", "NativeBundleOptions"]


@dataclass(frozen=True)
class NativeBundleOptions:
    """Options of the `native` backend."""

    threads: int = field(
        default=0, metadata={"help": "threads of a step; 0: as many as torch has", "ge": 0}
    )
    halvings: int = field(
        default=4,
        metadata={"help": "how often a guarded step that raised the energy is halved", "ge": 0},
    )


class NativeBundleAdjuster:
    """The step of the `torch` backend in compiled kernels (REFERENCE 3.2, 3.3), on a CPU.

    Linearisation, elimination of the depths and back-substitution each pass once over the cells,
    and nothing is stored per cell and edge. The reduced system is kept in an envelope and solved
    in float64. The same input gives the same bytes, whatever the number of threads.

    Raises:
        BuildError: the kernels could not be compiled or loaded.
    """

    def __init__(self, options: NativeBundleOptions | None = None) -> None:
        from droidw_plugins.bundle._native_calls import NativeKernels

        self._options = options or NativeBundleOptions()
        self._kernels = NativeKernels()

    def step(self, problem: BAProblem) -> Step:
        """One damped step; see `BAProblem` for the energy and `Report` for what may go wrong."""
        import torch

        threads = self._options.threads or torch.get_num_threads()
        return self._kernels.step(problem, threads, self._options.halvings)


def _build(options: NativeBundleOptions, context: BuildContext) -> BundleAdjuster:
    from droidw_plugins.bundle._build import BuildError

    try:
        return NativeBundleAdjuster(options)
    except BuildError as error:
        what, _, hint = str(error).partition("; ")
        raise MissingRequirementError(f"ba 'native' cannot run here: {what}", hint) from error


def _available() -> str:
    """Whether there is a compiler that has not failed yet; compiling is left to the factory."""
    from droidw_plugins.bundle._build import failure_of
    from droidw_plugins.bundle._native_calls import native_recipe

    recipe = native_recipe()
    return "no C++ compiler (g++ or clang)" if recipe is None else failure_of(recipe)


COMPONENT: Component[BundleAdjuster] = Component(
    name="native",
    summary="the torch backend's step in kernels compiled for this processor",
    factory=_build,
    options=NativeBundleOptions,
    capabilities=frozenset({"cpu"}),
    reference="DROID-SLAM, Teed and Deng 2021, section 3.3; own code",
    available=_available,
)
