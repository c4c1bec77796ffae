"""Options of what is solved for: bundle adjustment, its schedule, and what counts in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from droidw.config.fields import opt

__all__ = ["LinesConfig", "PhaseConfig", "SolverConfig", "WeightingConfig"]


@dataclass
class SolverConfig:
    """Damping and robustness of bundle adjustment in one phase."""

    lm: float = opt(1e-4, "relative damping of the reduced system", ge=0)
    ep: float = opt(0.1, "absolute damping of the reduced system", ge=0)
    depth_damping: float = opt(1.0, "factor on the damping of depths (`weighting`)", ge=0)
    huber: float = opt(0.2, "Huber threshold in grid cells (0: quadratic)", ge=0)
    cauchy: float = opt(
        0.0, "residual in grid cells at which a Cauchy kernel halves a weight (0: none)", ge=0
    )
    cauchy_tuning: float = opt(
        0.0,
        "makes that kernel follow what was measured: this many times the median residual wide, "
        "`cauchy` at most (0: always `cauchy`)",
        ge=0,
    )
    cauchy_slip: float = opt(
        0.0,
        "share of a residual's whole length that this kernel counts besides its length in the "
        "directions in which the match is known: gives up what has slipped along a line",
        ge=0,
    )
    planes: float = opt(
        0.0,
        "how much it counts in steps of all keyframes that walls and floors are flat, where lines "
        "do: a cell that is off by a hundredth of its depth as much as so many matches with a "
        "usual residual (0: not at all)",
        ge=0,
    )
    guard: bool = opt(False, "shorten or reject a step that raises the energy")


@dataclass
class PhaseConfig:
    """One row of the schedule (REFERENCE 4.4): how one phase alternates its parts."""

    updates: int = opt(4, "update steps (correspondence, then bundle adjustment)", ge=0)
    iterations: int = opt(2, "Gauss-Newton iterations per update step", ge=1)
    learn: bool = opt(True, "uncertainty is updated after each Gauss-Newton iteration")
    weigh: bool = opt(True, "uncertainty weighs the residuals")
    depth_prior: bool = opt(True, "the depth prior takes part")


@dataclass
class WeightingConfig:
    """How similarity becomes uncertainty u, and u a weight in [0,1] (REFERENCE 3.1)."""

    similarity: Literal["matched", "raw"] = opt(
        "matched",
        "how alike features are: matched: on one scale for all extractors, by measured matches; "
        "raw: their cosine, as published",
    )
    gate: Literal["rational", "inverse", "none"] = opt(
        "rational", "rational: 1/max(slope*u - shift, floor); inverse: 1/u; both clamped to [0,1]"
    )
    slope: float = opt(45.0, "slope of the rational gate", gt=0)
    shift: float = opt(35.0, "shift of the rational gate", ge=0)
    parted: bool = opt(
        True, "after `backend.learn` half closed where values part best in two, if later"
    )
    floor: float = opt(0.1, "smallest denominator of the rational gate", gt=0)
    closed_below: float = opt(
        0.5,
        "after `backend.learn` a cell that would keep less of its weight than this keeps none: "
        "what moves together pulls together, however little each cell weighs (0: as the gate says)",
        ge=0,
        le=1,
    )
    open_share: float = opt(
        0.5,
        "share of each picture, of what is least uncertain, that keeps its whole weight: most of "
        "what is seen stands still (0: no such share)",
        ge=0,
        le=1,
    )
    open_late: float = opt(
        0.3,
        "`open_share` after `backend.learn`, if that is less: what moves may hide most of a "
        "picture, and is known better by then",
        ge=0,
        le=1,
    )
    bidirectional: bool = opt(False, "also weigh by the gate sampled in the target frame")
    confidence_scale: float = opt(1.0, "factor on the confidence of correspondence", gt=0)
    damping_scale: float = opt(0.2, "factor on the learned depth damping", ge=0)
    damping_floor: float = opt(0.1, "added to the depth damping", ge=0)
    prior_weight: float = opt(0.001, "gamma_d, weight of the depth prior", ge=0)
    min_disp: float = opt(1e-3, "smallest disparity", gt=0)
    max_disp: float = opt(0.0, "largest disparity (0: unbounded)", ge=0)


@dataclass
class LinesConfig:
    """Lines along three directions at right angles, which tell how the camera is turned."""

    weight: float = opt(
        30.0,
        "how much they count: a line whose end is a fifth of a pixel off the direction that its "
        "keyframe's pose gives it as much as so many matches with a usual residual, of a "
        "correspondence that finds lines (0: not at all)",
        ge=0,
    )
    least_share: float = opt(
        0.8,
        "share of the length of all lines that must be along such directions, in half of the first "
        "keyframes and later of all, for them to count",
        ge=0,
        le=1,
    )
    doubt: float = opt(
        0.75, "factor on `backwards_below`, `restart_below`, `again_below` where lines count", ge=0
    )
