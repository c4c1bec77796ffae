"""Pictures without what moves, so that a search does not follow it.

The coarse levels of a search see what is large and has texture, and lead what is near it astray.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from droidw.geometry.contour import grown
from droidw.geometry.contour import outlined as up_to_contours
from droidw_plugins.correspondence._flow_information import structure
from droidw_plugins.correspondence._flow_types import Array, Edge, FlowFrame

__all__ = ["bridge", "outlined", "rounded", "searched", "softened", "surer", "without"]

Picture = npt.NDArray[np.uint8]

# Pixels around a mask that go with it: contours are blurred, by compression and by resizing.
_MARGIN = 2
# Smallest side of the coarsest level, and the share of known pixels that counts as some.
_COARSEST = 2
_SOME = 1e-3
# Share of cells below which a bridge is not worth a second search.
_FEW = 0.02


def without(grey: Picture, mask: npt.NDArray[np.bool_]) -> Picture:
    """The picture with a smooth bridge over what the mask covers; the rest stays as it is.

    Pyramids of the picture and of what is known of it are averaged downwards, and gaps filled
    from the next coarser level on the way up (pull and push: Gortler et al., The Lumigraph, 1996,
    section 3.4). The bridge has no edges of its own that could be matched.

    Args:
        grey: [H,W] uint8.
        mask: [H,W], True where the picture is to be ignored.
    """
    covered = grown(mask, _MARGIN)
    if not covered.any():
        return grey
    known: Any = 1.0 - covered.astype(np.float32)
    sums, shares = [grey * known], [known]
    while min(sums[-1].shape) > _COARSEST:
        sums.append(cv2.pyrDown(sums[-1]))
        shares.append(cv2.pyrDown(shares[-1]))
    bridge: Any = sums[-1] / np.maximum(shares[-1], _SOME)
    for level, share in zip(sums[-2::-1], shares[-2::-1], strict=True):
        above = cv2.pyrUp(bridge, dstsize=(level.shape[1], level.shape[0]))
        bridge = level + above * (1.0 - share)
    return np.where(covered, rounded(bridge), grey)


def softened(grey: Picture | Array, sigma: float) -> Array:
    """The picture [H,W] after a Gaussian blur of so many pixels (0: none), grey levels.

    Noise and the blocks of compression stand still while a wall moves, and on a bare wall they are
    all that a search sees besides lines a pixel wide, which it only finds from within that pixel.
    """
    exact = grey.astype(np.float32, copy=False)
    if sigma == 0:
        return exact
    soft: Any = cv2.GaussianBlur(exact, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    blurred: Array = soft
    return blurred


def rounded(grey: Array) -> Picture:
    """The picture [H,W] in whole grey levels."""
    whole: Picture = np.clip(grey + 0.5, 0, 255).astype(np.uint8)
    return whole


def searched(sharp: Picture, blur: float) -> tuple[Picture, Picture | None]:
    """`grey` and `unsoftened` of the frame of a picture [H,W]."""
    return (rounded(softened(sharp, blur)), sharp) if blur > 0 else (sharp, None)


def outlined(grey: Picture, closed: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """What closed cells [h,w] cover of a picture [H,W], up to its contours, at most a cell away.

    A cell that is covered in part is closed as a whole, and what is seen of it could be matched.
    """
    return up_to_contours(grey, _pixels(closed, grey) > 0, grey.shape[0] // closed.shape[0])


def _pixels(cells: npt.NDArray[Any], grey: Picture) -> npt.NDArray[np.uint8]:
    """The values of cells [h,w] at the pixels of a picture [H,W]."""
    height, width = grey.shape
    drawn: Any = cv2.resize(
        cells.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST
    )
    return np.asarray(drawn, np.uint8)


def bridge(
    frame: FlowFrame,
    gate: Array,
    below: float,
    reach: int,
    blur: float = 0.0,
    outline: bool = True,
) -> FlowFrame:
    """The frame with a bridge over the cells whose gate [h,w] is less than `below`.

    It is the frame itself where these are too few to matter. Structure beside the bridge is that
    of what lies more than `reach` pixels from it (0: of the picture); in closed cells it stays that
    of the picture, by which they keep some confidence.

    Args:
        blur: of pictures that are searched, pixels, as in `softened`.
        outline: it ends at contours, as of `outlined`; else where cells end.
    """
    closed = gate < below
    if closed.mean() < _FEW:
        return frame
    moving = outlined(frame.sharp, closed) if outline else _pixels(closed, frame.sharp) > 0
    grey, unsoftened = searched(without(frame.sharp, moving), blur)
    made = replace(frame, grey=grey, unsoftened=unsoftened, bridged=closed)
    if reach == 0:
        return made
    covered = moving if frame.covered is None else moving | frame.covered
    seen = softened(frame.sharp, blur)
    left = structure(seen, frame.centres, frame.stride, grown(covered, reach))
    whole = frame.texture, frame.power, frame.normal
    texture, power, normal = (
        np.where(closed[..., None], w, part) for w, part in zip(whole, left, strict=True)
    )
    return replace(made, texture=texture, power=power, normal=normal)


def surer(
    edge: Edge,
    other: Edge,
    bridged: npt.NDArray[np.bool_] | None,
    share: float = 1.0,
    clearly: float = 1.0,
) -> Edge:
    """The edge, with those matches of another search of it that are surer.

    Args:
        bridged: [h,w] cells of which the other search knows nothing; None: nowhere.
        share: of their confidence that these keep. Gates alone leave what moves too much where
            nine tenths of all confidence lie on it.
        clearly: how many times as sure a match has to be.
    """
    better = other.confidence[..., :2].sum(-1) > clearly * edge.confidence[..., :2].sum(-1)
    if bridged is not None:
        better &= ~bridged
    target = np.where(better[..., None], other.target, edge.target)
    confidence = np.where(better[..., None], other.confidence, edge.confidence)
    if bridged is not None:
        confidence = np.where(bridged[..., None], np.float32(share) * confidence, confidence)
    return replace(edge, target=target, confidence=confidence)
