"""Options of global bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from droidw.config.fields import opt

__all__ = ["BackendConfig"]


@dataclass
class BackendConfig:
    """Global bundle adjustment after tracking."""

    passes: list[int] = opt([2, 2, 2, 2, 2], "update steps of each global pass", ge=1)
    more_passes: int = opt(
        4,
        "times that the last pass is made again at most, if `edges_hidden` is reached, while it "
        "moves what poses and depths predict by more than `at_rest`, but for a path of which less "
        "than `restart_below` agrees",
        ge=0,
    )
    at_rest: float = opt(
        0.006,
        "cells by which a pass may move what poses and depths predict, in the median of a "
        "keyframe: a tenth of all keyframes may be above",
        ge=0,
    )
    wide_start: float = opt(
        16.0,
        "how many times wider than `global_solver.cauchy` the kernel of the first of several "
        "passes is: what has broken off is drawn back before its matches are given up",
        ge=1,
    )
    last_tuning: float = opt(
        1.0, "`global_solver.cauchy_tuning` after the first pass with it (0: the same)", ge=0
    )
    last_slip: float = opt(0.5, "`global_solver.cauchy_slip` of those passes", ge=0)
    last_planes: float = opt(
        0.1, "`global_solver.planes` of those passes, if `planes_hidden` is reached", ge=0
    )
    planes_hidden: float = opt(
        0.05,
        "share of all cells that uncertainty and masks close, from which `last_planes` counts: "
        "what is in sight is better known by its matches",
        ge=0,
        le=1,
    )
    between: int = opt(
        1,
        "frames of each gap between keyframes that become keyframes, too, before the passes with "
        "`last_tuning`, if `between_hidden` is reached, but for a path of which less than "
        "`restart_below` agrees: by then poses and depths are known",
        ge=0,
    )
    between_hidden: float = opt(
        0.1,
        "share of all cells that uncertainty and masks close, from which `between` counts: more "
        "pictures make up for what is hidden in each of them (1: never)",
        ge=0,
        le=1,
    )
    beta: float = opt(0.75, "mix of full and translational flow in the frame distance", ge=0, le=1)
    threshold: float = opt(25.0, "largest frame distance of an edge, in cells", gt=0)
    radius: int = opt(1, "neighbours always linked", ge=1)
    nms: int = opt(
        3,
        "suppression radius around chosen edges, in keyframes; in more of them where "
        "`motion_filter.movable_nearer` brings them nearer",
        ge=0,
    )
    nms_shape: Literal["square", "diamond"] = opt(
        "diamond", "what a chosen edge suppresses; diamond: little near the diagonal"
    )
    normalize: bool = opt(False, "mean disparity becomes 1 before passes without a depth prior")
    factors_per_keyframe: int = opt(
        10,
        "directed edges per keyframe at most; as many more as `motion_filter.movable_nearer` "
        "brings keyframes nearer",
        ge=2,
    )
    last_nms: int = opt(
        1,
        "`nms` of the passes with `last_tuning`, if `edges_hidden` is reached and this is less",
        ge=0,
    )
    last_factors: int = opt(
        20, "`factors_per_keyframe` of these passes, if that is reached and this is more", ge=2
    )
    edges_hidden: float = opt(
        0.05,
        "share of all cells that uncertainty and masks close, from which the last passes have more "
        "edges: what is hidden in some pairs is seen in others (1: never)",
        ge=0,
        le=1,
    )
    backwards_below: float = opt(
        0.7,
        "agreement of all matches with poses and depths below which keyframes are tracked once "
        "more, from the last to the first, and that is kept if more agrees (0: never, 1: however "
        "much agrees)",
        ge=0,
        le=1,
    )
    broken_below: float = opt(
        0.15,
        "agreement of the matches across some place between two keyframes below which the path has "
        "broken there: it is in doubt, and tracked backwards, however much agrees in all; of two "
        "ways one that has not broken is kept (0: never)",
        ge=0,
        le=1,
    )
    splice: bool = opt(True, "of the way that agrees less, take the pieces in which more agrees")
    restart_below: float = opt(
        0.8,
        "agreement below which pieces that points contradict set out anew even where there is no "
        "doubt; whether there is, is asked of what comes of it (0: never, 1: however much agrees)",
        ge=0,
        le=1,
    )
    restarts: int = opt(
        1,
        "times that pieces of what was kept of the way back set out anew from a steady motion, "
        "where that explains far more of the points that correspondence matches by their "
        "descriptors",
        ge=0,
        le=4,
    )
    points: float = opt(
        5.0,
        "how much the points that correspondence matches by their descriptors count for what was "
        "kept of the way back: one that is a fifth of a pixel off its epipolar line as much as so "
        "many matches with a usual residual (0: not at all)",
        ge=0,
    )
    seen_through: float = opt(
        0.02,
        "share of all cells that are open though later keyframes see nearer things where they seem "
        "to be, as of what goes ahead of the camera, from which these are closed and all passes "
        "made once more, but for a path of which less than `restart_below` agrees (1: never)",
        ge=0,
        le=1,
    )
    learn: bool = opt(True, "let uncertainty learn anew after the first pass, from a mended path")
    relearn: bool = opt(True, "let uncertainty learn once more, from what was kept of the way back")
    turns: int = opt(
        3,
        "times that the passes are made with `relearn` and `motion_prior` for what was kept of "
        "the way back",
        ge=1,
    )
    beyond: float = opt(
        2.0,
        "how far past two of these turns the next one sets out, in lengths of the last of them: "
        "turns lead the same way, each less far than the one before (0: where the last one ended)",
        ge=0,
        le=4,
    )
    motion_prior: float = opt(
        100.0,
        "how much steady motion counts for what was kept of the way back: in a first pass, a "
        "change of velocity that is usual for the path as much as so many matches with a usual "
        "residual; in each pass after it a third of that, in the last one nothing",
        ge=0,
    )
