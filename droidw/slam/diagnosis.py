"""What kind of motion a run had, so that a user is told when poses cannot mean much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from droidw.geometry.projective import NEAR, pixel_grid, relative_pose, reproject
from droidw.graph.store import KeyframeStore
from droidw.slam.doubt import Link

__all__ = ["Diagnosis", "diagnose", "parallax", "unusable"]


@dataclass(frozen=True)
class Diagnosis:
    """Facts about the motion in the footage.

    Attributes:
        frames: frames looked at; keyframes: keyframes kept.
        still: the camera did not move; all poses are the same.
        unmatched: no two frames could be matched at all, so that nothing is known.
        lost: share of frames that could not be matched with the frame before at all.
        parallax: share of the flow between neighbouring keyframes that no turn of the camera
            explains, see `parallax`; NaN if unknown.
        points: points of the static cloud, None if unknown.
        agreement: share of what global adjustment measured that agrees with poses and depths, see
            `explained_share`; NaN if unknown.
        weakest: where least of that agrees, see `weakest_link`.
        broken: so little that the path has broken there.
        backwards: share of the path between keyframes that was tracked from the last one to the
            first.
    """

    frames: int
    keyframes: int
    still: bool
    lost: float
    unmatched: bool = False
    parallax: float = float("nan")
    points: int | None = None
    agreement: float = float("nan")
    weakest: Link = Link()
    broken: bool = False
    backwards: float = 0.0

    def warnings(self) -> list[str]:
        """Sentences for the log and the report."""
        told = []
        if self.frames == 1:
            told.append("one frame only: its pose is the identity and no depth is known")
        elif self.still and not self.unmatched:
            told.append("the camera did not move: every pose is the same and no depth can be known")
        elif self.keyframes > 1 and self.parallax < MIN_PARALLAX:
            told.append(
                f"almost no parallax (only {self.parallax:.1%} of the flow between keyframes is "
                "not explained by turning): the camera seems to turn on the spot; rotations are "
                "usable, positions and depths are not; move sideways while filming"
            )
        elif self.keyframes > 1:
            told += self._thin()
        if self.broken:
            told.append(
                f"only {self.weakest.share:.0%} of what was matched across frame "
                f"{self.weakest.frame} agrees with poses and depths: the path has broken there, "
                "and its parts may differ in scale; look at the pictures around that frame, and "
                "cut the clip there if they show little but blank walls, blur or what moves"
            )
        if self.lost > 0.05:
            told.append(
                f"{self.lost:.0%} of the frames could not be matched with their predecessor "
                "(blank, blurred or unrelated pictures); their poses are interpolated"
            )
        return told

    def _thin(self) -> list[str]:
        """What to say of a camera that moved, but left few keyframes or no points."""
        cloud = ", and no depth was confirmed by others: the cloud is empty" * (self.points == 0)
        if self.keyframes < 3:
            return [
                f"only {self.keyframes} of {self.frames} frames became keyframes, since little "
                f"moved between them{cloud}; poses rest on these alone; try a longer clip, all of "
                "its frames (--stride 1), or a smaller motion_filter.threshold and "
                "frontend.keyframe_threshold"
            ]
        if self.points == 0:
            return [
                "the point cloud is empty: no static cell has a depth that other keyframes "
                "confirm, since too little moved or poses are wrong; try a longer clip, a "
                "calibration (--calib, --focal), or a larger cloud.relative_threshold"
            ]
        return []


MIN_PARALLAX = 0.05
"""Share of the flow that no turn explains, below which positions mean little.

Measured: cameras that only turn have 0.01 to 0.04, hand-held ones and cars 0.08 to 0.4.
"""

_MOST_PAIRS = 256  # enough for a median
_ROUNDS = 8


def diagnose(
    store: KeyframeStore, frames: int, matched: Sequence[float], lost_below: float
) -> Diagnosis:
    """Facts known after tracking.

    Args:
        store: keyframes.
        frames: how many were tracked.
        matched: matched share of each frame but the first with its reference.
        lost_below: matched share of a frame that counts as lost.
    """
    lost = sum(share < lost_below for share in matched) / max(1, len(matched))
    return Diagnosis(
        frames=frames,
        keyframes=len(store),
        still=len(store) < 2,
        lost=lost,
        unmatched=len(matched) > 0 and lost == 1.0,
    )


def parallax(store: KeyframeStore, weight: Tensor) -> float:
    """Share of the flow between neighbouring keyframes that no turn of the camera explains.

    The flow due to translation alone, of all cells by their weights, less the turn that explains
    most of it: a translation sideways and a turn look alike where depth varies little, and so
    poses of a camera that only turns have a translation, too. The turn is that of least absolute
    error, so that an object that moves by itself does not count as parallax. Median length of
    what is left, over that of the whole flow.

    Args:
        store: keyframes.
        weight: [N,h,w] in [0,1], what masks and uncertainty leave of a cell.
    Returns:
        The ratio; NaN with fewer than two keyframes, or where no cell has a weight.
    """
    pairs = len(store) - 1
    if pairs < 1:
        return float("nan")
    ii = torch.linspace(0, pairs - 1, min(pairs, _MOST_PAIRS), device=store.device).round().long()
    t = relative_pose(store.T_cw, ii, ii + 1)[:, None, None, :3] * store.disps[ii][..., None]
    fx, fy, cx, cy = store.intrinsics.unbind()
    grid = pixel_grid(store.grid.height, store.grid.width, device=store.device)
    a, b = (grid[..., 0] - cx) / fx, (grid[..., 1] - cy) / fy
    depth = 1.0 + t[..., 2]
    ahead = depth.clamp_min(NEAR)
    flow = torch.stack(
        (fx * (t[..., 0] - a * t[..., 2]) / ahead, fy * (t[..., 1] - b * t[..., 2]) / ahead), -1
    )
    coords, valid = reproject(store.T_cw, store.disps, store.intrinsics, ii, ii + 1)
    size = torch.tensor([store.grid.width, store.grid.height], device=store.device)
    seen = ((coords >= 0) & (coords <= size - 1)).all(-1)
    used = weight[ii] * (valid & seen & (depth >= NEAR))
    if not float(used.sum()) > 0:
        return float("nan")
    flow = torch.where(used[..., None] > 0, flow, 0.0)
    whole = _median(torch.linalg.vector_norm(coords - grid, dim=-1), used)
    # Flow of a small turn about x, y and z (REFERENCE 2.3).
    J = torch.stack(
        (
            torch.stack((-a * b, 1 + a * a, -b), -1) * fx,
            torch.stack((-(1 + b * b), a * b, a), -1) * fy,
        ),
        -2,
    )
    left = _without_turn(flow, J, used, 0.02 * whole)
    return _median(left, used) / max(whole, 1e-9)


def _without_turn(flow: Tensor, J: Tensor, weight: Tensor, least: float) -> Tensor:
    """Length [E,h,w] of the flow [E,h,w,2] less the turns of least absolute error.

    Args:
        J: [h,w,2,3], flow of a small turn.
        weight: [E,h,w].
        least: differences below this count as one of this size, cells.
    """
    JJ = torch.einsum("hwcp,hwcq->hwpq", J, J)
    some = 1e-6 * torch.eye(3, device=J.device)
    left: Tensor = torch.linalg.vector_norm(flow, dim=-1)
    for _ in range(_ROUNDS):
        scale = weight / left.clamp_min(max(least, 1e-9))
        A = torch.einsum("ehw,hwpq->epq", scale, JJ) + some
        turn = torch.linalg.solve(A, torch.einsum("ehwc,hwcp->ep", scale[..., None] * flow, J))
        rest = flow - torch.einsum("hwcp,ep->ehwc", J, turn)
        left = torch.linalg.vector_norm(rest, dim=-1)
    return left


def _median(values: Tensor, weight: Tensor) -> float:
    """The value with half of the weight (of the same shape, not all 0) on either side."""
    order = values.flatten().argsort()
    sums = weight.flatten()[order].double().cumsum(0)
    return float(values.flatten()[order[int(torch.searchsorted(sums, sums[-1] / 2))]])


def unusable(store: KeyframeStore) -> dict[str, int]:
    """How many cells of all keyframes have an uncertainty that is none: by the name of a report.

    The gate closes what is not finite, and takes what is negative for what is sure.
    """
    u = store["uncertainty"]
    count = int((~(u.isfinite() & (u >= 0))).sum())
    return {"unusable": count} if count else {}
