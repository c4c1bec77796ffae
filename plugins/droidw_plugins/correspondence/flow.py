"""Correspondence `flow`: dense inverse search optical flow, the default that needs no download."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from droidw.interfaces.correspondence import Correspondence
from droidw.plugin.component import BuildContext, Component

__all__ = ["COMPONENT", "FlowOptions"]


@dataclass(frozen=True)
class FlowOptions:
    """Options of correspondence `flow`; lengths in pixels of the working image."""

    stride: int = field(default=8, metadata={"help": "grid cell in pixels", "ge": 2, "le": 16})
    blur: float = field(
        default=0.7,
        metadata={
            "help": "Gaussian blur, in pixels, of the pictures that are searched (0: none)",
            "ge": 0.0,
            "le": 4.0,
        },
    )
    finest_scale: int = field(
        default=1,
        metadata={"help": "finest pyramid level of the search (0: full size)", "ge": 0, "le": 3},
    )
    global_scale: int = field(
        default=0,
        metadata={"help": "the same for global bundle adjustment", "ge": 0, "le": 3},
    )
    iterations: int = field(
        default=12, metadata={"help": "gradient descent iterations per patch", "ge": 1, "le": 100}
    )
    patch_size: int = field(
        default=8, metadata={"help": "side of the patches of the search, pixels", "ge": 4, "le": 32}
    )
    patch_stride: int = field(
        default=5, metadata={"help": "pixels between the patches of the search", "ge": 1, "le": 8}
    )
    refinement: int = field(
        default=3, metadata={"help": "variational refinement iterations", "ge": 0, "le": 20}
    )
    global_refinement: int = field(
        default=1,
        metadata={"help": "the same for global bundle adjustment", "ge": 0, "le": 20},
    )
    warp: bool = field(
        default=True,
        metadata={
            "help": "global bundle adjustment searches the second picture as it looks through the "
            "flow that poses and depths predict, and so are frames between keyframes seen again: "
            "patches move as one, and what is seen at a slant does not (false: patches set out "
            "from that flow, and these frames are seen once)"
        },
    )
    curved: bool = field(
        default=True,
        metadata={
            "help": "flow that poses and depths predict bends between cells, as along a floor or a "
            "wall at a slant (false: it is straight from one cell to the next)"
        },
    )
    fill_window: int = field(
        default=9,
        metadata={
            "help": "width of the windows in which frames between keyframes are matched again, at "
            "full size, as found and then as predicted (below 3: as the search left them)",
            "ge": 0,
            "le": 31,
        },
    )
    again_coarsest: int = field(
        default=8,
        metadata={
            "help": "coarsest pyramid level (0: full size; 8: all there are) of a search that "
            "global bundle adjustment makes again, if predictions have moved by less than half a "
            "cell since: coarser ones see what moves, and may lead what is near it astray",
            "ge": 0,
            "le": 8,
        },
    )
    consistency: float = field(
        default=0.5,
        metadata={"help": "forward-backward error at which confidence halves", "gt": 0.0},
    )
    cutoff: float = field(
        default=3.0, metadata={"help": "forward-backward error without any confidence", "gt": 0.0}
    )
    slide: float = field(
        default=6.0,
        metadata={
            "help": "forward-backward error without any confidence, across an edge along which "
            "a match may slip",
            "gt": 0.0,
        },
    )
    likeness: float = field(
        default=0.7,
        metadata={
            "help": "how fast confidence falls where a match leaves more difference in brightness "
            "than an error of position by a pixel would: e pixels leave "
            "1 / (1 + (e^2 - 1) / likeness^2) of it (0: not asked)",
            "ge": 0.0,
        },
    )
    texture: float = field(
        default=2.0,
        metadata={
            "help": "image gradient (grey levels) at which confidence along it halves",
            "ge": 0.0,
        },
    )
    edge_leak: float = field(
        default=0.1,
        metadata={
            "help": "power along an edge, as a share of that across it, at which confidence along "
            "it halves: bends and blur of a line do not hold a match that slips along it",
            "ge": 0.0,
        },
    )
    turn_reach: int = field(
        default=0,
        metadata={
            "help": "pixels along a line to either side at which the flow tells how it runs in the "
            "other picture, where a match counts across it (0: as it runs in the first one)",
            "ge": 0,
            "le": 32,
        },
    )
    reach: int = field(
        default=7,
        metadata={
            "help": "pixels around what a mask covers or uncertainty takes out that a search mixes "
            "with it: none of these counts as structure of a cell beside it (0: all do)",
            "ge": 0,
        },
    )
    border: float = field(
        default=5.0,
        metadata={
            "help": "pixels from the border of either picture below which a match counts a "
            "quarter: what lies beyond is not known, and matches there fall short (0: all in full)",
            "ge": 0.0,
            "le": 32.0,
        },
    )
    exposure: bool = field(
        default=True,
        metadata={
            "help": "what all of a picture has become brighter or darker is taken out before it is "
            "searched or compared (false: exposure is taken to be the same)"
        },
    )
    restart: float = field(
        default=2.0,
        metadata={
            "help": "cells between prediction and measurement that repeat a search",
            "gt": 0.0,
        },
    )
    restarts: int = field(default=1, metadata={"help": "repeated searches per edge", "ge": 0})
    bridge: float = field(
        default=0.5,
        metadata={
            "help": "gate of uncertainty below which a cell is taken out of the picture for a "
            "second search, whose matches count where they are surer (0: no second search)",
            "ge": 0.0,
            "le": 1.0,
        },
    )
    outline: bool = field(
        default=True,
        metadata={
            "help": "what is taken out so ends at the contours that the picture has about there "
            "(false: where cells end)"
        },
    )
    bridged_share: float = field(
        default=0.2,
        metadata={
            "help": "share of their confidence that matches from cells taken out so keep",
            "ge": 0.0,
            "le": 1.0,
        },
    )
    bridge_change: float = field(
        default=0.02,
        metadata={
            "help": "share of a picture's cells that may have been taken out of it or put back "
            "since a pair of pictures was searched, before it is searched anew",
            "ge": 0.0,
            "le": 1.0,
        },
    )
    seeds: int = field(
        default=1500,
        metadata={
            "help": "points of a keyframe that are matched by their descriptors (SIFT) where the "
            "path is in doubt, or pictures say little (seeds_below); another search sets out from "
            "those that are off what was found, and its matches count where they are surer "
            "(0: none)",
            "ge": 0,
        },
    )
    seeds_below: float = field(
        default=0.2,
        metadata={
            "help": "share of a picture's cells that stand still and have structure in two "
            "directions, below which points are matched before there is doubt, too "
            "(0: only in doubt; 1: always, for twice the time)",
            "ge": 0.0,
            "le": 1.0,
        },
    )
    still: float = field(
        default=0.35, metadata={"help": "flow that counts as no motion, in pixels", "ge": 0.0}
    )
    still_share: float = field(
        default=0.55,
        metadata={"help": "share of unmoved cells that means a camera at rest", "gt": 0, "le": 1},
    )
    motion_tiles: int = field(
        default=6,
        metadata={
            "help": "rows and columns of tiles whose middle motions are averaged to tell how much "
            "the picture moved (0: all cells alike; what moves with the camera and has most of the "
            "structure then keeps keyframes away)",
            "ge": 0,
            "le": 32,
        },
    )
    workers: int = field(default=0, metadata={"help": "threads (0: one per core)", "ge": 0})


def _build(options: Any, context: BuildContext) -> Correspondence:
    from droidw_plugins.correspondence._flow import FlowCorrespondence

    return FlowCorrespondence(options)


COMPONENT: Component[Correspondence] = Component(
    name="flow",
    summary="dense inverse search optical flow both ways, guided by the predicted flow",
    factory=_build,
    options=FlowOptions,
    requires=("cv2",),
    capabilities=frozenset({"cpu", "cuda", "host", "threads"}),
    reference="Kroeger et al., Fast Optical Flow using Dense Inverse Search, ECCV 2016; "
    "Lowe, Distinctive Image Features from Scale-Invariant Keypoints, IJCV 2004; "
    "OpenCV's implementations (Apache-2.0)",
)
