"""Options that the learned uncertainty models share: those of their common objective."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

__all__ = ["ObjectiveOptions"]


@dataclass(frozen=True)
class ObjectiveOptions:
    """Options of the consistency objective; the defaults are the published values (REFERENCE 4.3).

    What the published code and the paper do differently (REFERENCE 9) are options here, and
    `docs/uncertainty.md` lists the settings of either, and of each row of the ablations.
    """

    gamma_data: float = field(
        default=0.1, metadata={"help": "weight of the consistency loss (paper: 1)", "ge": 0}
    )
    gamma_prior: float = field(
        default=0.05, metadata={"help": "weight of the prior log(u + 1); 0: no prior", "ge": 0}
    )
    decoupled: bool = field(
        default=True,
        metadata={"help": "share the loss between both frames of an edge; false: 1/u_i^2"},
    )
    min_gap: int = field(
        default=2,
        metadata={"help": "keyframes between the ends of an edge that counts (paper: 1)", "ge": 1},
    )
    similarity_threshold: float = field(
        default=0.5,
        metadata={
            "help": "a cosine up to here counts as no similarity at all (paper: -1, none)",
            "ge": -1,
            "lt": 1,
        },
    )
    similarity_floor: float = field(
        default=0.0,
        metadata={
            "help": "cosines below count as this (paper: -1, none)",
            "ge": -1,
            "lt": 1,
        },
    )
    average: bool = field(
        default=True,
        metadata={
            "help": "mean over the edges of a frame and, for parameters, over cells and frames; "
            "false: sums, as the paper writes them, which need a far smaller step"
        },
    )
    bulk: float = field(
        default=0.0,
        metadata={
            "help": "where the middle cell of an edge is less similar than 1 - bulk, "
            "dissimilarities are scaled so that it is not (paper: 0, off)",
            "ge": 0,
            "lt": 1,
        },
    )
    smooth: int = field(
        default=0,
        metadata={"help": "write means of u over cells at most so far away (paper: 0)", "ge": 0},
    )
    residual_gain: float = field(
        default=0.0,
        metadata={
            "help": "how much measured motion that agrees with the poses lowers u, and motion "
            "that does not raises it (paper: 0)",
            "ge": 0,
            "le": 1,
        },
    )
    residual_scale: float = field(
        default=0.2, metadata={"help": "residual in cells at which agreement is a half", "gt": 0}
    )
    mended_gain: float = field(
        default=0.0,
        metadata={
            "help": "takes the place of residual_gain once global adjustment has mended the path; "
            "each measurement then has its say by itself (0: residual_gain goes on)",
            "ge": 0,
            "le": 1,
        },
    )
    residual_majority: float = field(
        default=0.0,
        metadata={
            "help": "share of the measured motion that must agree with the poses before residuals "
            "count; they count in full from 0.2 more (0: always)",
            "ge": 0,
            "lt": 1,
        },
    )
    learn_majority: float = field(
        default=0.0,
        metadata={
            "help": "where the model began with what can move: share of the measured motion that "
            "counts which must agree with the poses before anything is learned; steps are full "
            "from 0.2 more (0: always)",
            "ge": 0,
            "lt": 1,
        },
    )
    refresh: int = field(
        default=1,
        metadata={"help": "similarities are renewed at every n-th step on the same edges", "ge": 1},
    )
    tolerance: float = field(
        default=0.0,
        metadata={
            "help": "cells by which the projection of an edge may have moved on average since its "
            "similarities were taken; beyond, they are renewed (0: always)",
            "ge": 0,
        },
    )
    kernels: Literal["auto", "torch"] = field(
        default="auto",
        metadata={
            "help": "auto: the costly parts compiled at first use, on a CPU with a C++ compiler; "
            "torch: never"
        },
    )
