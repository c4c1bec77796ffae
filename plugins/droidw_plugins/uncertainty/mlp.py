"""Uncertainty model `mlp`: a shallow network from features to uncertainty, learned online."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component
from droidw_plugins.uncertainty._options import ObjectiveOptions

if TYPE_CHECKING:
    from droidw.interfaces.uncertainty import UncertaintyModel

__all__ = ["COMPONENT", "MlpOptions"]


@dataclass(frozen=True)
class MlpOptions(ObjectiveOptions):
    """Options of `mlp`: `u = log(1 + offset + e^y)`, `y = w2 . relu(W1 f + b1) + b2`."""

    hidden: int = field(default=16, metadata={"help": "units of the hidden layer", "ge": 1})
    lr: float = field(default=0.01, metadata={"help": "step of Adam", "ge": 0})
    weight_decay: float = field(
        default=0.002,
        metadata={"help": "share of the parameters that is lost per step", "ge": 0, "lt": 1},
    )
    momentum: float = field(
        default=0.9, metadata={"help": "Adam's decay of the mean gradient", "ge": 0, "lt": 1}
    )
    square_decay: float = field(
        default=0.99, metadata={"help": "Adam's decay of the mean square", "ge": 0, "lt": 1}
    )
    softplus_offset: float = field(
        default=0.1, metadata={"help": "u = log(1 + offset + e^y)", "ge": 0}
    )
    init_scale: float = field(
        default=0.0,
        metadata={
            "help": "factor on the random start of the last layer; 0 starts all cells at the "
            "same u, below the gate",
            "ge": 0,
        },
    )


def _build(options: MlpOptions, context: BuildContext) -> UncertaintyModel:
    from droidw_plugins.uncertainty._mlp import Mlp

    return Mlp(options, context)


COMPONENT: Component[UncertaintyModel] = Component(
    name="mlp",
    summary="u from a shallow network on the features, learned online on the same loss",
    factory=_build,
    options=MlpOptions,
    capabilities=frozenset({"cpu", "cuda", "features"}),
    reference="the predictor of NeRF On-the-go and WildGS-SLAM, on DROID-W's loss; own code",
)
