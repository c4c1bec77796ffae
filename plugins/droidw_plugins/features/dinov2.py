"""Feature extractor `dinov2`: the ViT-S/14 of DINOv2, with or without register tokens."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from droidw.plugin.component import BuildContext, Component
from droidw_plugins._weights import DINOV2_VITS14, DINOV2_VITS14_REG
from droidw_plugins.features._patch_options import PatchOptions

if TYPE_CHECKING:
    from droidw.interfaces.features import FeatureExtractor
    from droidw.plugin.weights import WeightsFile

__all__ = ["COMPONENT", "Dinov2Options"]


@dataclass(frozen=True)
class Dinov2Options(PatchOptions):
    """Options of the extractor `dinov2`."""

    variant: Literal["vits14-reg", "vits14"] = field(
        default="vits14-reg", metadata={"help": "ViT-S/14 with four register tokens or without"}
    )


def _record(options: Dinov2Options) -> WeightsFile:
    return DINOV2_VITS14_REG if options.variant == "vits14-reg" else DINOV2_VITS14


def _weights(options: Dinov2Options) -> tuple[WeightsFile, ...]:
    return () if options.weights else (_record(options),)


def _build(options: Dinov2Options, context: BuildContext) -> FeatureExtractor:
    from droidw_plugins.features._patches import PatchFeatures

    return PatchFeatures(_record(options), options, context)


COMPONENT: Component[FeatureExtractor] = Component(
    name="dinov2",
    summary="DINOv2 ViT-S/14 patch features, with or without register tokens",
    factory=_build,
    options=Dinov2Options,
    weights=_weights,
    capabilities=frozenset({"cpu", "cuda", "features"}),
    reference="Oquab et al. 2023, DINOv2; Darcet et al. 2023 (registers); code and weights "
    "Apache-2.0",
)
