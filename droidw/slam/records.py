"""What leaves a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from droidw.geometry.se3 import inv
from droidw.slam.frame import KeyframeRecord
from droidw.slam.seen_through import evidence

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.geometry.camera import Camera, Grid
    from droidw.graph.store import KeyframeStore
    from droidw.slam.diagnosis import Diagnosis
    from droidw.slam.focal import FocalSearch
    from droidw.slam.frame import CloudPoints, Trajectory

__all__ = ["Outcome", "keyframe_records"]


@dataclass(frozen=True)
class Outcome:
    """What tracking came to; all that is left of a `SlamSystem`.

    Attributes:
        trajectory: poses of all frames.
        keyframes, cloud: records on the CPU.
        diagnosis: what to say of it.
        camera: the working camera, with the focal length that was found.
        grid: where the cells of a keyframe's maps lie.
        focal: what the search for the focal length came to, None where there was none.
        last_index: index in the source of the frame tracked last.
        metric: depth came from a prior in metres.
        reports: status of steps that were left out -> how many.
    """

    trajectory: Trajectory
    keyframes: tuple[KeyframeRecord, ...]
    cloud: CloudPoints
    diagnosis: Diagnosis
    camera: Camera
    grid: Grid
    focal: FocalSearch | None
    last_index: int
    metric: bool
    reports: Mapping[str, int]


def keyframe_records(
    store: KeyframeStore, valid: Tensor, weight: Tensor
) -> tuple[KeyframeRecord, ...]:
    """A record of every keyframe, on the CPU.

    Args:
        valid: [N,h,w] bool, depth seen consistently by other keyframes.
        weight: [N,h,w] in [0,1], what masks and uncertainty leave of a cell.
    """
    T_wc = inv(store.T_cw.double()).cpu().numpy()
    intrinsics = store.image_intrinsics.double().cpu().numpy()
    uncertainty = store["uncertainty"] + evidence(store["through"])
    return tuple(
        KeyframeRecord(
            index=info.index,
            time=info.time,
            name=info.name,
            image=info.image,
            T_wc=T_wc[n],
            intrinsics=intrinsics,
            disp=store.disps[n].float().cpu().numpy().copy(),
            depth_valid=valid[n].cpu().numpy(),
            uncertainty=uncertainty[n].float().cpu().numpy().copy(),
            weight=weight[n].float().cpu().numpy().copy(),
            disp_full=info.disp_full,
        )
        for n, info in enumerate(store.infos)
    )
