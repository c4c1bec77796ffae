"""Keyframes as they leave a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from droidw.geometry.se3 import inv
from droidw.slam.frame import KeyframeRecord

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.graph.store import KeyframeStore

__all__ = ["keyframe_records"]


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
            uncertainty=store["uncertainty"][n].float().cpu().numpy().copy(),
            weight=weight[n].float().cpu().numpy().copy(),
            disp_full=info.disp_full,
        )
        for n, info in enumerate(store.infos)
    )
