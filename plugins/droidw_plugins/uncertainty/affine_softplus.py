"""Uncertainty model `affine-softplus`, the paper's: one affine map from features to uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.uncertainty import UncertaintyModel

__all__ = ["COMPONENT", "AffineSoftplusOptions"]


@dataclass(frozen=True)
class AffineSoftplusOptions:
    """Options of `affine-softplus`; the defaults are the published values (REFERENCE 4.3)."""

    lr: float = field(default=0.1, metadata={"help": "step of gradient descent", "ge": 0})
    weight_decay: float = field(
        default=0.002,
        metadata={"help": "share of the parameters that is lost per step", "ge": 0, "lt": 1},
    )
    gamma_data: float = field(
        default=0.1, metadata={"help": "weight of the consistency loss", "ge": 0}
    )
    gamma_prior: float = field(
        default=0.05, metadata={"help": "weight of the prior log(u + 1)", "ge": 0}
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
    min_gap: int = field(
        default=2, metadata={"help": "keyframes between the ends of an edge that counts", "ge": 1}
    )
    similarity_threshold: float = field(
        default=0.5,
        metadata={"help": "a cosine up to here counts as no similarity at all", "ge": 0, "lt": 1},
    )
    decoupled: bool = field(
        default=True,
        metadata={"help": "share the loss between both frames of an edge; false: 1/u_i^2"},
    )
    affine: bool = field(
        default=True,
        metadata={"help": "map features to u; false: a free u per cell, in [u_min, u_max]"},
    )
    u_min: float = field(default=0.1, metadata={"help": "smallest u where not affine", "gt": 0})
    u_max: float = field(default=2.0, metadata={"help": "largest u where not affine", "gt": 0})
    refresh: int = field(
        default=1,
        metadata={"help": "similarities are renewed at every n-th step on the same edges", "ge": 1},
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
