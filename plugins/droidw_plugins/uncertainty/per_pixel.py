"""Uncertainty model `per-pixel`: a free value per cell, the paper's ablation without affine map."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component
from droidw_plugins.uncertainty._options import ObjectiveOptions

if TYPE_CHECKING:
    from droidw.interfaces.uncertainty import UncertaintyModel

__all__ = ["COMPONENT", "PerPixelOptions"]


@dataclass(frozen=True)
class PerPixelOptions(ObjectiveOptions):
    """Options of `per-pixel`; the defaults are the published values (REFERENCE 4.3)."""

    lr: float = field(
        default=0.1,
        metadata={"help": "step of gradient descent; short schedules want about 2", "ge": 0},
    )
    start: float = field(
        default=0.742, metadata={"help": "u of a new keyframe, below the gate", "gt": 0}
    )
    u_min: float = field(default=0.1, metadata={"help": "smallest u", "gt": 0})
    u_max: float = field(default=2.0, metadata={"help": "largest u", "gt": 0})


def _build(options: PerPixelOptions, context: BuildContext) -> UncertaintyModel:
    from droidw_plugins.uncertainty._per_pixel import PerPixel

    return PerPixel(options, context)


COMPONENT: Component[UncertaintyModel] = Component(
    name="per-pixel",
    summary="a free u per cell of each keyframe, on the same loss (ablation: no affine map)",
    factory=_build,
    options=PerPixelOptions,
    capabilities=frozenset({"cpu", "cuda", "features"}),
    reference="DROID-W, ablation 'w/o affine mapping'",
)
