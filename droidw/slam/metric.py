"""The scale of a result, where a depth prior knows metres.

Matches say nothing of it, so it drifts in global adjustment, which holds the first pose alone.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from droidw.interfaces.depth import GoesWithFocal

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.graph.store import KeyframeStore
    from droidw.interfaces.depth import DepthPrior
    from droidw.slam.focal import FocalSearch

__all__ = ["deeper", "scale_to_prior"]

# Cells of which a median says something.
_ENOUGH = 100

_log = logging.getLogger(__name__)


def deeper(prior: DepthPrior, focal: FocalSearch | None) -> float:
    """How many times as deep all is as the prior said, by the focal length that was found since.

    Frames, those of keyframes from between others too, come with the one that was given.
    """
    goes = isinstance(prior, GoesWithFocal) and prior.goes_with_focal
    return focal.factor if goes and focal is not None else 1.0


def scale_to_prior(store: KeyframeStore, valid: Tensor, deeper: float = 1.0) -> float:
    """Give poses and depths the scale of the depth prior: the median of what it says of each cell.

    Args:
        store: its poses [N,7], disparities [N,h,w] and full-size maps are overwritten.
        valid: bool [N,h,w], cells whose depth was measured and confirmed. Others keep what the
            prior said when they began, and would hold on to the scale of that time.
        deeper: how many times as deep all is as the prior said.
    Returns:
        The factor by which all was too small; 1 where the prior knows fewer than a hundred of these
        cells.
    """
    prior = store["prior"]
    known = valid & (prior > 0) & (store.disps > 0)
    if int(known.sum()) < _ENOUGH:
        return 1.0
    factor = math.exp(float((store.disps[known].log() - prior[known].log()).median()))
    factor *= deeper
    store.T_cw[:, :3].mul_(factor)
    store.disps.div_(factor)
    for info in store.infos:
        if info.disp_full is not None:
            info.disp_full = info.disp_full / factor
    _log.info("scale: by the depth prior all was %.4g times too small", factor)
    return factor
