"""What kind of motion a run had, so that a user is told when poses cannot mean much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from droidw.geometry import se3
from droidw.geometry.projective import pixel_grid
from droidw.graph.store import KeyframeStore

__all__ = ["Diagnosis", "diagnose", "parallax"]


@dataclass(frozen=True)
class Diagnosis:
    """Facts about the motion in the footage.

    Attributes:
        frames: frames looked at; keyframes: keyframes kept.
        still: the camera did not move; all poses are the same.
        unmatched: no two frames could be matched at all, so that nothing is known.
        lost: share of frames that could not be matched with the frame before at all.
        parallax: median flow due to translation between neighbouring keyframes, in cells; 0
            for a camera that only turns, NaN with fewer than two keyframes.
    """

    frames: int
    keyframes: int
    still: bool
    lost: float
    unmatched: bool = False
    parallax: float = float("nan")

    def warnings(self) -> list[str]:
        """Sentences for the log and the report."""
        told = []
        if self.frames == 1:
            told.append("one frame only: its pose is the identity and no depth is known")
        elif self.still and not self.unmatched:
            told.append("the camera did not move: every pose is the same and no depth can be known")
        elif self.keyframes > 1 and self.parallax < MIN_PARALLAX:
            told.append(
                f"almost no parallax (median {self.parallax:.2f} grid cells between keyframes): "
                "the camera seems to turn on the spot; rotations are usable, positions and "
                "depths are not"
            )
        if self.lost > 0.05:
            told.append(
                f"{self.lost:.0%} of the frames could not be matched with their predecessor "
                "(blank, blurred or unrelated pictures); their poses are interpolated"
            )
        return told


MIN_PARALLAX = 0.05
"""Median translational flow between keyframes, in cells, below which positions mean little."""


def diagnose(
    store: KeyframeStore, moved: Sequence[float], matched: Sequence[float], lost_below: float
) -> Diagnosis:
    """Facts known after tracking.

    Args:
        store: keyframes.
        moved: flow of each frame but the first against its reference, cells.
        matched: matched share of the same.
        lost_below: matched share of a frame that counts as lost.
    """
    lost = sum(share < lost_below for share in matched) / max(1, len(matched))
    return Diagnosis(
        frames=len(moved) + 1,
        keyframes=len(store),
        still=len(store) < 2,
        lost=lost,
        unmatched=len(matched) > 0 and lost == 1.0,
    )


def parallax(store: KeyframeStore) -> float:
    """Median length, over cells and neighbouring keyframes, of the flow due to translation."""
    count = len(store)
    if count < 2:
        return float("nan")
    ii = torch.arange(count - 1, device=store.device)
    G = se3.mul(store.T_cw[ii + 1], se3.inv(store.T_cw[ii]))
    fx, fy, cx, cy = store.intrinsics.unbind()
    grid = pixel_grid(store.grid.height, store.grid.width, device=store.device)
    t = G[:, None, None, :3] * store.disps[ii][..., None]
    depth = (1.0 + t[..., 2]).clamp_min(0.1)
    dx = (fx * t[..., 0] - (grid[..., 0] - cx) * t[..., 2]) / depth
    dy = (fy * t[..., 1] - (grid[..., 1] - cy) * t[..., 2]) / depth
    return float(torch.hypot(dx, dy).median())
