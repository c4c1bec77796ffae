"""Whether a path has come to rest: by how much a pass moved what it predicts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from droidw.geometry.projective import reproject
from droidw.geometry.transfer import upload
from droidw.solve.weights import CLOSED

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.graph.store import KeyframeStore
    from droidw.slam.path import Path

__all__ = ["moved_by"]

# How many keyframes apart those are that cells are predicted in, before and behind.
_APART = (-8, -4, -2, -1, 1, 2, 4, 8)
# Of all keyframes, by how much each has moved, the share that is not above the result. Pieces that
# have not come to rest are longer than a tenth; a few keyframes that stray are not waited for.
_MOST = 0.9


def moved_by(before: Path, store: KeyframeStore, gates: Tensor) -> float:
    """Cells by which what poses and depths predict has moved: where each cell is in near keyframes.

    Unlike poses and depths that has a scale that is known. It is the median of a keyframe, which a
    tenth of them exceed; 0 if there is only one, or all is closed.

    Args:
        before: poses and depths as they were, of as many keyframes.
        gates: [N,h,w] in [0,1]; what is closed does not count.
    """
    count = len(store)
    medians = []
    for k in range(count):
        jj = [k + apart for apart in _APART if 0 <= k + apart < count]
        ii = [k] * len(jj)
        pairs = upload(torch.tensor([ii, jj], dtype=torch.int64), store.device)
        (was, seen), (now, still) = (
            reproject(T_cw, disps, store.intrinsics, *pairs)
            for T_cw, disps in ((before.T_cw, before.disps), (store.T_cw, store.disps))
        )
        counts = seen & still & (gates[k] >= CLOSED)
        medians.append((now - was).norm(dim=-1).masked_fill(~counts, torch.nan).nanmedian())
    return float(torch.stack(medians).cpu().nanquantile(_MOST).nan_to_num())
