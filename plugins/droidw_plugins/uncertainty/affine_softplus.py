"""Uncertainty model `affine-softplus`, the paper's: one affine map from features to uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component
from droidw_plugins.uncertainty._options import ObjectiveOptions

if TYPE_CHECKING:
    from droidw.interfaces.uncertainty import UncertaintyModel

__all__ = ["COMPONENT", "AffineSoftplusOptions"]


@dataclass(frozen=True)
class AffineSoftplusOptions(ObjectiveOptions):
    """Options of `affine-softplus`; the defaults are the published values (REFERENCE 4.3)."""

    lr: float = field(default=0.1, metadata={"help": "step of gradient descent", "ge": 0})
    weight_decay: float = field(
        default=0.002,
        metadata={
            "help": "share of the parameters, or of the way from where they started with "
            "movable_gain, that is lost per step",
            "ge": 0,
            "lt": 1,
        },
    )
    softplus_offset: float = field(
        default=0.1,
        metadata={"help": "u = log(1 + offset + e^y); 0 is the paper's form", "ge": 0},
    )
    bias: bool = field(default=True, metadata={"help": "learn a bias (the paper's form has none)"})
    init_scale: float = field(
        default=1.0,
        metadata={
            "help": "factor on the random start of the weights, N(0, 1/C); 0 starts all cells at "
            "the same u, below the gate",
            "ge": 0,
        },
    )
    movable_gain: float = field(
        default=0.0,
        metadata={
            "help": "parameters start, and decay, at a fit of y = gain (p - movable_at); p is "
            "how much speaks for what can move by itself, by the features (0: not asked)",
            "ge": 0,
        },
    )
    movable_keep: float = field(
        default=0.0,
        metadata={
            "help": "fit anew at every keyframe, with this share of what earlier ones counted "
            "(0: while tracking, the keyframes of the initialisation only)",
            "ge": 0,
            "le": 1,
        },
    )
    movable_at: float = field(
        default=0.55,
        metadata={"help": "p at which y starts at 0", "ge": 0, "le": 1},
    )


def _build(options: AffineSoftplusOptions, context: BuildContext) -> UncertaintyModel:
    from droidw_plugins.uncertainty._affine import AffineSoftplus

    return AffineSoftplus(options, context)


COMPONENT: Component[UncertaintyModel] = Component(
    name="affine-softplus",
    summary="u = softplus(w.f + b), one vector for the whole run, learned online (paper)",
    factory=_build,
    options=AffineSoftplusOptions,
    capabilities=frozenset({"cpu", "cuda", "features"}),
    reference="DROID-W, section 'Uncertainty Optimization'",
)
