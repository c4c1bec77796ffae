"""Correspondence `synthetic`: exact answers for footage of reader `synthetic`, for tests."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from droidw.interfaces.correspondence import Correspondence
from droidw.plugin.component import BuildContext, Component

__all__ = ["COMPONENT", "SyntheticCorrespondenceOptions"]


@dataclass(frozen=True)
class SyntheticCorrespondenceOptions:
    """Options of correspondence `synthetic`; the scene must be the one that the reader shows."""

    scene: str = field(
        default="handheld", metadata={"help": "name of the scene, as in source synthetic:NAME"}
    )
    frames: int = field(default=60, metadata={"help": "as reader.options.frames", "ge": 1})
    width: int = field(default=320, metadata={"help": "as reader.options.width", "ge": 32})
    height: int = field(default=240, metadata={"help": "as reader.options.height", "ge": 32})
    fps: float = field(default=30.0, metadata={"help": "as reader.options.fps", "gt": 0})
    seed: int = field(default=0, metadata={"help": "as reader.options.seed", "ge": 0})
    stride: int = field(default=8, metadata={"help": "grid cell in pixels", "ge": 1, "le": 64})
    noise_px: float = field(
        default=0.0,
        metadata={"help": "noise on targets, standard deviation in working pixels", "ge": 0},
    )
    outlier_share: float = field(
        default=0.0,
        metadata={
            "help": "share of cells with a wrong target and full confidence",
            "ge": 0,
            "le": 1,
        },
    )
    outlier_px: float = field(
        default=40.0, metadata={"help": "largest error of a wrong target, working pixels", "ge": 0}
    )
    confidence: float = field(
        default=1.0, metadata={"help": "confidence of a visible cell", "gt": 0}
    )


def _build(options: Any, context: BuildContext) -> Correspondence:
    from droidw_plugins.correspondence._synthetic import SyntheticCorrespondence

    return SyntheticCorrespondence(options, seed=context.seed)


COMPONENT: Component[Correspondence] = Component(
    name="synthetic",
    summary="exact correspondence of synthetic footage, with noise and outliers on demand (tests)",
    factory=_build,
    options=SyntheticCorrespondenceOptions,
    requires=("cv2",),
    capabilities=frozenset({"cpu", "cuda", "threads"}),
)
