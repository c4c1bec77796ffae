"""The configuration as dataclasses: every key, its default, its range and what it means.

Defaults here are those of preset `cpu`. `metadata["help"]` feeds `--help`, `docs/` and error
messages; `metadata["ge"]`, `["gt"]`, `["le"]`, `["lt"]` are checked when a config is resolved.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from droidw.config.adjusting import BackendConfig
from droidw.config.fields import opt
from droidw.config.solving import LinesConfig, PhaseConfig, SolverConfig, WeightingConfig

__all__ = [
    "BackendConfig",
    "CameraConfig",
    "CloudConfig",
    "DroidwConfig",
    "FillerConfig",
    "FrontendConfig",
    "InputConfig",
    "LinesConfig",
    "MotionFilterConfig",
    "PhaseConfig",
    "SlotConfig",
    "SolverConfig",
    "WeightingConfig",
    "opt",
]


@dataclass
class SlotConfig:
    """A plugin by name and its options; a bare name is shorthand for `{name: ...}`."""

    name: str = opt("???", "name of the plugin (droidw list-plugins)")
    options: dict[str, Any] = opt({}, "options of that plugin (droidw list-plugins --options NAME)")


@dataclass
class InputConfig:
    """What is read."""

    source: str = opt("", "folder, video file, or reader:sequence")
    stride: int = opt(1, "keep every n-th picture", ge=1)
    skip: int = opt(0, "leave out the first n pictures", ge=0)
    max_frames: int = opt(0, "stop after n pictures (0: all)", ge=0)
    masks: str = opt("", "folder with a mask per picture: what is not black there is ignored")


@dataclass
class CameraConfig:
    """The camera and the working size."""

    calib: str | None = opt(None, "calibration file; overrides what the source says")
    focal: float | None = opt(None, "focal length in pixels of the raw picture", gt=0)
    fov: float | None = opt(None, "horizontal field of view in degrees", gt=1, lt=179)
    long_side: int = opt(320, "working size: the longer side is reduced to this, in pixels", ge=64)
    size: list[int] = opt([], "working size [width, height] instead of `long_side`")
    edge: int = opt(0, "pixels cropped off each side after resizing", ge=0)
    refine_focal: bool = opt(True, "look for a better focal length in global adjustment")
    focal_trust: float = opt(
        10.0, "how hard a focal length is to move: curvature of its prior; a guess: a tenth", ge=0
    )
    focal_slack: float = opt(
        0.01, "a known focal length is kept if what is found differs by less (logarithm)", ge=0
    )
    focal_range: float = opt(0.3, "largest change of the logarithm of the focal length", gt=0, le=1)


@dataclass
class MotionFilterConfig:
    """Which frames become candidates for keyframes."""

    threshold: float = opt(1.25, "mean flow from the last keyframe, in grid cells", gt=0)
    movable_above: float = opt(
        0.1,
        "cells of the last keyframe with more evidence than this for what can move by itself do "
        "not tell how far a picture moved, where uncertainty begins with that: keyframes come "
        "nearer where something hides the motion of the camera (0: all do)",
        ge=0,
        le=1,
    )
    movable_nearer: float = opt(
        1.0,
        "how much nearer keyframes come by the share of a picture that is set aside or masked, "
        "where that is more than a tenth (from 0.3 on in full), half at most: `threshold` and "
        "`frontend.keyframe_threshold` times one less that share times this (0: no nearer)",
        ge=0,
        le=1,
    )
    force_every: int = opt(0, "a keyframe at least every n frames (0: never forced)", ge=0)
    min_matched: float = opt(
        0.4,
        "a frame in which less than this share of the cells is matched is taken at once",
        ge=0,
        le=1,
    )
    lost_below: float = opt(
        0.03, "matched share below which a frame counts as blank or unrelated", ge=0, le=1
    )
    patience: int = opt(10, "unrelated frames in a row after which one is taken all the same", ge=1)
    last_above: float = opt(
        0.25,
        "share of `threshold` by which the picture has moved since the last keyframe for the last "
        "frame to become one, so that no frame lies beyond all keyframes (1: it is as any other)",
        ge=0,
        le=1,
    )


@dataclass
class FrontendConfig:
    """Initialisation and the sliding window."""

    warmup: int = opt(8, "keyframes before initialisation", ge=2)
    beta: float = opt(0.75, "mix of full and translational flow in the frame distance", ge=0, le=1)
    init_beta: float = opt(0.25, "the same during initialisation", ge=0, le=1)
    keyframe_threshold: float = opt(
        0.8, "distance below which the newest keyframe is dropped", ge=0
    )
    keep_below: float = opt(
        0.6,
        "share of the measured motion that must agree with the newest pose for its keyframe to be "
        "dropped (0: not asked)",
        ge=0,
        le=1,
    )
    threshold: float = opt(8.0, "largest frame distance of a proximity edge, in cells", gt=0)
    window: int = opt(25, "keyframes searched for proximity edges", ge=2)
    radius: int = opt(2, "neighbours always linked", ge=1)
    nms: int = opt(2, "suppression radius around existing edges", ge=0)
    max_factors: int = opt(75, "active edges at most", ge=4)
    max_age: int = opt(12, "updates after which an edge is retired", ge=1)
    predict: Literal["match", "velocity", "hold", "damped"] = opt(
        "velocity",
        "velocity: go on with the last motion and depth; match: then move to where the last "
        "keyframe is found again; hold: last pose, mean depth; "
        "damped: half of the last motion, median depth",
    )
    starts: bool = opt(True, "at initialisation, try several starts and keep what fits best")
    surrounds: float = opt(
        1.1,
        "with `starts`: how many times farther over the picture what agrees with a start must "
        "reach than with what was found, to be taken for what stands still; asked where lines do "
        "not tell how the camera is turned (0: not asked)",
        ge=0,
    )
    redundant: Literal["newest", "middle"] = opt(
        "newest",
        "which keyframe is dropped where too little moved: the newest, if near to the one before; "
        "middle: the last but two, if its neighbours are nearer than twice the threshold",
    )
    again_below: float = opt(
        0.65,
        "agreement of all matches with poses and depths in the end below which the footage is "
        "tracked once more, without what the first time was found to move, if that is 2 % of the "
        "pictures or more (0: never, 1: however much agrees)",
        ge=0,
        le=1,
    )
    unknown_moves: float = opt(
        0.15,
        "share of the pictures found to move, though the classifier does not say that it can, from "
        "which the footage is tracked once more without the rest: that may be the one thing that "
        "moves. What agrees farther over the picture is kept (1: never)",
        ge=0,
        le=1,
    )


@dataclass
class FillerConfig:
    """Poses of the frames that are not keyframes."""

    updates: int = opt(2, "motion-only update steps per batch", ge=0)
    keyframes: int = opt(2, "keyframes on either side that a frame is measured from", ge=1)
    smooth: bool = opt(
        True,
        "draw frames between keyframes to a steady motion, by how exact they are and how much the "
        "camera shakes, both read from the path",
    )
    batch: int = opt(16, "frames per batch", ge=1)
    cache_mb: int = opt(
        512, "memory for what correspondence keeps of frames; beyond it they are read again", ge=0
    )


@dataclass
class CloudConfig:
    """Which depths count as seen consistently, and go into the static cloud."""

    relative_threshold: float = opt(0.02, "largest relative disagreement with a neighbour", gt=0)
    min_views: int = opt(2, "neighbouring keyframes that must agree", ge=0)
    min_weight: float = opt(0.5, "smallest uncertainty weight of a static point", ge=0, le=1)
    far: float = opt(4.0, "depths beyond this many times the median are left out (0: keep)", ge=0)
    max_points: int = opt(2_000_000, "points at most; evenly thinned beyond", ge=1)


@dataclass
class DroidwConfig:
    """A whole run."""

    input: InputConfig = field(default_factory=InputConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)

    reader: SlotConfig = field(default_factory=lambda: SlotConfig("auto"))
    features: SlotConfig = field(default_factory=lambda: SlotConfig("cnn"))
    depth: SlotConfig = field(default_factory=lambda: SlotConfig("none"))
    uncertainty: SlotConfig = field(default_factory=lambda: SlotConfig("affine-softplus"))
    ba: SlotConfig = field(default_factory=lambda: SlotConfig("auto"))
    correspondence: SlotConfig = field(default_factory=lambda: SlotConfig("flow"))
    exporters: dict[str, Any] = opt(
        {"trajectory": {}, "ply": {}, "uncertainty": {}, "depth": {}},
        "exporter name -> its options; null switches one off",
    )
    observers: dict[str, Any] = opt(
        {"progress": {}, "report": {}}, "observer name -> its options; null switches one off"
    )

    motion_filter: MotionFilterConfig = field(default_factory=MotionFilterConfig)
    frontend: FrontendConfig = field(default_factory=FrontendConfig)
    backend: BackendConfig = field(default_factory=BackendConfig)
    filler: FillerConfig = field(default_factory=FillerConfig)
    weighting: WeightingConfig = field(default_factory=WeightingConfig)
    lines: LinesConfig = field(default_factory=LinesConfig)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    schedule: dict[str, PhaseConfig] = field(
        default_factory=lambda: {
            "init_blind": PhaseConfig(updates=8, weigh=False),
            "init": PhaseConfig(updates=8),
            "init_again": PhaseConfig(updates=0),
            "window": PhaseConfig(updates=1),
            "window_kept": PhaseConfig(updates=1),
            "global": PhaseConfig(updates=0, iterations=8, learn=False, depth_prior=False),
            "fill": PhaseConfig(updates=0, iterations=8, learn=False, depth_prior=False),
        },
        metadata={
            "help": "phases: init_blind, init, init_again, window, window_kept, global, fill"
        },
    )
    solver: SolverConfig = field(default_factory=lambda: SolverConfig(cauchy=0.15, cauchy_slip=1.0))
    global_solver: SolverConfig = field(
        default_factory=lambda: SolverConfig(
            lm=1e-6, ep=1e-4, depth_damping=0.01, cauchy=0.75, cauchy_tuning=5.0, cauchy_slip=2.0
        )
    )
    filler_solver: SolverConfig = field(
        default_factory=lambda: SolverConfig(cauchy=0.15, cauchy_tuning=0.5, cauchy_slip=0.5)
    )

    device: str = opt("auto", "auto, cpu, cuda, cuda:N")
    seed: int = opt(0, "seed of everything that draws numbers", ge=0, le=2**32 - 1)
    threads: int = opt(0, "cores to use, half of them for torch (0: all)", ge=0)
    compat: list[str] = opt([], "published behaviours to reproduce, e.g. [droid-w]")
