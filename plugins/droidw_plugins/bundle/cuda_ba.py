"""Bundle adjustment backend `cuda`: the kernels compiled for this GPU at first use."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.errors import MissingRequirementError
from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    import torch

    from droidw.interfaces.bundle import BundleAdjuster
    from droidw.solve.problem import BAProblem, Step

__all__ = ["COMPONENT", "CudaBundleAdjuster", "CudaBundleOptions"]


@dataclass(frozen=True)
class CudaBundleOptions:
    """Options of the `cuda` backend."""

    halvings: int = field(
        default=4,
        metadata={"help": "how often a guarded step that raised the energy is halved", "ge": 0},
    )


class CudaBundleAdjuster:
    """The step of the `torch` backend in CUDA kernels (REFERENCE 3.2, 3.3).

    No kernel adds floating-point numbers from several threads to one place, so that the same input
    gives the same bytes. The reduced system is solved in float64 on the device; from 500 keyframes
    on only those of its tiles are kept that are not 0.

    Args:
        options: see `CudaBundleOptions`.
        device: the GPU; the current one if not given.

    Raises:
        BuildError: there is no GPU, or the kernels could not be compiled or loaded.
    """

    def __init__(
        self, options: CudaBundleOptions | None = None, device: torch.device | None = None
    ) -> None:
        from droidw_plugins.bundle._kernel_calls import KernelLibrary
        from droidw_plugins.bundle._kernel_step import KernelStepper

        options = options or CudaBundleOptions()
        self._stepper = KernelStepper(KernelLibrary.for_cuda(device), options.halvings)

    def step(self, problem: BAProblem) -> Step:
        """One damped step; see `BAProblem` for the energy and `Report` for what may go wrong."""
        return self._stepper.step(problem)


def _build(options: CudaBundleOptions, context: BuildContext) -> BundleAdjuster:
    from droidw_plugins.bundle._build import BuildError
    from droidw_plugins.bundle._trial import try_step

    try:
        backend = CudaBundleAdjuster(options, context.device)
        # A driver may be older than the compiler, and kernels made beforehand for another GPU.
        try_step(backend, context.device)
    except BuildError as error:
        what, _, hint = str(error).partition("; ")
        raise MissingRequirementError(f"ba 'cuda' cannot run here: {what}", hint) from error
    except RuntimeError as error:
        raise MissingRequirementError(
            f"ba 'cuda' cannot run here: {error}",
            "the torch backend runs on the GPU without own kernels: ba=torch",
        ) from error
    return backend


def _available() -> str:
    """Whether there is a GPU and a compiler that has not failed yet; the factory compiles."""
    import torch

    if not torch.cuda.is_available():
        return "no GPU visible"
    from droidw_plugins.bundle._build import failure_of
    from droidw_plugins.bundle._kernel_calls import cuda_recipe, prebuilt

    if prebuilt() is not None:
        return ""
    recipe = cuda_recipe()
    return "no nvcc (the CUDA toolkit's compiler)" if recipe is None else failure_of(recipe)


COMPONENT: Component[BundleAdjuster] = Component(
    name="cuda",
    summary="the torch backend's step in CUDA kernels compiled for this GPU",
    factory=_build,
    options=CudaBundleOptions,
    capabilities=frozenset({"cuda"}),
    reference="DROID-SLAM, Teed and Deng 2021, section 3.3; own code",
    available=_available,
)
