"""The description of the plugin: light, since droidw imports it to list what there is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import droidw

if TYPE_CHECKING:
    from droidw.interfaces.features import FeatureExtractor

__all__ = ["COMPONENT", "GradientOptions", "droidw_feature_extractors"]


@dataclass(frozen=True)
class GradientOptions:
    """Options of `gradients`; every field needs a default, unknown keys are refused by droidw."""

    levels: int = field(
        default=3, metadata={"help": "scales, each half as sharp as the last", "ge": 1, "le": 6}
    )
    gain: float = field(
        default=4.0, metadata={"help": "weight of gradients against brightness", "gt": 0}
    )


def _build(options: GradientOptions, context: droidw.BuildContext) -> FeatureExtractor:
    from droidw_plugin_template.gradients import GradientFeatures

    return GradientFeatures(levels=options.levels, gain=options.gain)


COMPONENT: droidw.Component[FeatureExtractor] = droidw.Component(
    name="gradients",
    summary="brightness and image gradients at several scales, no weights",
    factory=_build,
    options=GradientOptions,
    capabilities=frozenset({"cpu", "cuda", "features"}),
    reference="template of droidw, Apache-2.0",
)


@droidw.hookimpl
def droidw_feature_extractors() -> Iterable[droidw.Component[FeatureExtractor]]:
    """What this plugin offers; a plugin may implement any number of hooks."""
    yield COMPONENT
