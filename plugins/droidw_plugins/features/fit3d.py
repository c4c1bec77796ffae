"""Feature extractor `fit3d`: DINOv2 ViT-S/14 fine-tuned for consistency between views."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from droidw.plugin.component import BuildContext, Component
from droidw_plugins._weights import FIT3D, FIT3D_PLAIN
from droidw_plugins.features._patch_options import PatchOptions

if TYPE_CHECKING:
    from droidw.interfaces.features import FeatureExtractor
    from droidw.plugin.weights import WeightsFile

__all__ = ["COMPONENT", "Fit3dOptions"]


@dataclass(frozen=True)
class Fit3dOptions(PatchOptions):
    """Options of the extractor `fit3d`."""

    variant: Literal["reg-small", "small"] = field(
        default="reg-small",
        metadata={
            "help": "dinov2_reg_small_fine, which has four register tokens, or dinov2_small_fine"
        },
    )


def _record(options: Fit3dOptions) -> WeightsFile:
    return FIT3D if options.variant == "reg-small" else FIT3D_PLAIN


def _weights(options: Fit3dOptions) -> tuple[WeightsFile, ...]:
    return () if options.weights else (_record(options),)


def _build(options: Fit3dOptions, context: BuildContext) -> FeatureExtractor:
    from droidw_plugins.features._patches import PatchFeatures

    return PatchFeatures(_record(options), options, context)


COMPONENT: Component[FeatureExtractor] = Component(
    name="fit3d",
    summary="FiT3D: DINOv2 ViT-S/14 fine-tuned for consistency between views, as in the paper",
    factory=_build,
    options=Fit3dOptions,
    weights=_weights,
    capabilities=frozenset({"cpu", "cuda", "features"}),
    reference="Yue et al. 2024, FiT3D; code MIT, nothing separate is said of the weights",
)
