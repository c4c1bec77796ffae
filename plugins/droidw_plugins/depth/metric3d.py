"""Depth prior `metric3d`: Metric3D v2, metric depth from a single picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from droidw.plugin.component import BuildContext, Component
from droidw_plugins._weights import METRIC3D_VIT_LARGE, METRIC3D_VIT_SMALL

if TYPE_CHECKING:
    from droidw.interfaces.depth import DepthPrior
    from droidw.plugin.weights import WeightsFile

__all__ = ["COMPONENT", "Metric3dOptions"]


@dataclass(frozen=True)
class Metric3dOptions:
    """Options of the depth prior `metric3d`; the defaults are those of the published system."""

    variant: Literal["vit-large", "vit-small"] = field(
        default="vit-large",
        metadata={"help": "size of the network: 412 or 37 million parameters"},
    )
    size: list[int] = field(
        default_factory=lambda: [616, 1064],
        metadata={
            "help": "[height, width] of what the network sees, multiples of 28; the picture is "
            "fitted into it. Smaller is faster, and further from what the network was trained on"
        },
    )
    precision: Literal["auto", "float32", "bfloat16", "float16"] = field(
        default="auto",
        metadata={
            "help": "of matrix products and convolutions; auto: float16 on a GPU, float32 on a "
            "CPU, which knows no float16"
        },
    )
    weights: str | None = field(
        default=None,
        metadata={"help": "path of a checkpoint (none: the one that droidw weights fetched)"},
    )


def _record(options: Metric3dOptions) -> WeightsFile:
    return METRIC3D_VIT_SMALL if options.variant == "vit-small" else METRIC3D_VIT_LARGE


def _weights(options: Metric3dOptions) -> tuple[WeightsFile, ...]:
    return () if options.weights else (_record(options),)


def _build(options: Metric3dOptions, context: BuildContext) -> DepthPrior:
    from droidw_plugins.depth._metric3d import Metric3dDepth

    return Metric3dDepth(_record(options), options, context)


COMPONENT: Component[DepthPrior] = Component(
    name="metric3d",
    summary="Metric3D v2 (ViT-L or ViT-S): metric depth from a single picture, as in the paper",
    factory=_build,
    options=Metric3dOptions,
    weights=_weights,
    capabilities=frozenset({"cpu", "cuda", "depth"}),
    reference="Hu et al. 2024, Metric3D v2; code BSD-2-Clause, nothing separate is said of the "
    "weights",
)
