"""How far all keyframes are apart, of which there are many in long footage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from droidw.geometry.projective import frame_distance
from droidw.geometry.transfer import upload

if TYPE_CHECKING:
    from droidw.graph.store import KeyframeStore

__all__ = ["distances_between"]

# Pairs whose distance is computed at once; bounds memory, not the result.
_CHUNK = 2048
# Keyframes from which on every third row and column of cells tells how far they are apart: pairs
# grow with their square, and would take longer than all else. A mean needs no more.
_MANY, _EACH = 300, 3


def distances_between(
    store: KeyframeStore, keyframes: Sequence[int], beta: float
) -> npt.NDArray[np.float64]:
    """Frame distances [n,n] of keyframes and those before them, in cells; infinite elsewhere.

    Args:
        store: poses and disparities. keyframes: numbers of some, ascending.
        beta: as of `frame_distance`.
    """
    count = len(keyframes)
    each = _EACH if count > _MANY else 1
    disps = store.disps[:, ::each, ::each].contiguous() if each > 1 else store.disps
    at = torch.tensor(list(keyframes), dtype=torch.int64)
    ii, jj = torch.tril_indices(count, count, -1)
    near = [torch.zeros(0)]
    for start in range(0, len(ii), _CHUNK):
        part = slice(start, start + _CHUNK)
        near.append(
            frame_distance(
                store.T_cw,
                disps,
                store.intrinsics / each,  # cell (x, y) of these lies at cell `each` * (x, y)
                upload(at[ii[part]], store.device),
                upload(at[jj[part]], store.device),
                beta,
            ).cpu()
        )
    distance = np.full((count, count), np.inf)
    distance[ii.numpy(), jj.numpy()] = each * torch.cat(near).double().numpy()
    return distance
