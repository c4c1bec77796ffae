"""What matches of `flow` are off by in common, in a rendered scene of which true ones are known.

Random errors of matches average out over a path, and what all of them are off by does not: some
thousandths of the flow let its scale drift. Pictures are predicted by the truth, so that nothing
but the search is measured, and compared as in global adjustment.

    python benchmarks/match_bias.py street --seed 11
    python benchmarks/match_bias.py track --seed 12 curved=false

Mean errors are weighted by confidence times a Cauchy kernel of 0.1 px, of cells that both pictures
show: along the flow as a share of it, and downwards in pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt
import torch
from omegaconf import OmegaConf
from scenery import SCENES, Renderer

from droidw.geometry.camera import Grid
from droidw.slam.frame import Frame
from droidw.testing._shapes import cast
from droidw_plugins.correspondence._flow import FlowCorrespondence
from droidw_plugins.correspondence.flow import FlowOptions

Array = npt.NDArray[np.float64]

GAPS = (1, 3, 6)
_KERNEL, _FARTHEST, _SLACK = 0.1, 0.5, 0.1  # px; px; share of a depth


class Known:
    """A rendered scene without what moves in it, and where each cell is seen from elsewhere.

    Args:
        name: of SCENES. seed: of the scene. size: (width, height) of its pictures.
    """

    def __init__(
        self, name: str, seed: int, size: tuple[int, int], flow: FlowCorrespondence
    ) -> None:
        self.scene = Renderer(replace(SCENES[name], size=size), seed)
        self.frames = self.scene.made.frames
        self._flow = flow
        self._grid = Grid.of(size[1], size[0], flow.stride, flow.offset)
        self.cells = self._grid.centres().numpy().astype(np.float64)
        self._bodies, self._poses = self.scene.still()
        # A picture is in several pairs, and its depth is asked for there and back.
        self.payload, self.depth = cache(self._payload), cache(self._depth)

    def _payload(self, k: int) -> object:
        """Picture number k as `flow` encodes it."""
        image = torch.from_numpy(self.scene.render(k, False)[0]).permute(2, 0, 1).float() / 255
        intrinsics = torch.from_numpy(self.scene.intrinsics).float()
        return self._flow.encode(Frame(k, k / self.scene.made.fps, image, intrinsics), self._grid)

    def _depth(self, k: int) -> Array:
        """Depth [h,w] of the cells of picture number k."""
        x, y = (self.cells[..., axis].ravel().astype(np.float32) for axis in (0, 1))
        hits = cast(self._bodies, self._poses, self.scene.pose(k), self.scene.intrinsics, x, y)
        return hits.depth.reshape(self.cells.shape[:2]).astype(np.float64)

    def flow(self, i: int, j: int) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Displacement [h,w,2] of the cells of picture i to picture j, and which both show."""
        depth, other = self.depth(i), self.depth(j)
        focal, centre = self.scene.intrinsics[:2], self.scene.intrinsics[2:]
        far = np.where(np.isfinite(depth), depth, 1e4)[..., None]
        points = np.concatenate([(self.cells - centre) / focal * far, far], axis=-1)
        a, b = self.scene.pose(i), self.scene.pose(j)
        there = (points @ a.R.T + a.t - b.t) @ b.R
        to = there[..., :2] / there[..., 2:] * focal + centre
        cell = ((to - self._flow.offset) / self._flow.stride).astype(np.float32)
        met = cv2.remap(other.astype(np.float32), cell, None, cv2.INTER_LINEAR)
        inside = ((to > 5) & (to < np.array(self.scene.made.size) - 6)).all(axis=-1)
        shown = inside & (np.abs(there[..., 2] - met) < _SLACK * there[..., 2])
        return to - self.cells, shown & np.isfinite(depth)

    def errors(self, i: int, j: int) -> tuple[Array, Array]:
        """Rows dx, dy, flow x, flow y, weight x, weight y of matches there, and back."""
        flow = self._flow
        (there, seen), (back, met) = self.flow(i, j), self.flow(j, i)
        a, b = self.payload(i), self.payload(j)
        starts = [
            ((self.cells + moved - flow.offset) / flow.stride).astype(np.float32)
            for moved in (there, back)
        ]
        edges = flow.both_ways(a, b, *starts, True, bridged=(a, b))
        rows = []
        for edge, moved, shown in zip(edges, (there, back), (seen, met), strict=True):
            off = edge.target * flow.stride + flow.offset - self.cells - moved
            rows.append(np.concatenate([off, moved, edge.confidence[..., :2]], axis=-1)[shown])
        return rows[0], rows[1]


def biases(rows: Array) -> tuple[float, float, float]:
    """Median error, px; mean error along the flow, as a share of it; mean error downwards, px."""
    off, moved, weight = rows[:, :2], rows[:, 2:4], rows[:, 4:6]
    length = np.hypot(*off.T)
    share = ((length < _FARTHEST) / (1 + (length / _KERNEL) ** 2))[:, None] * weight
    along = (share * moved * off).sum() / (share * moved * moved).sum()
    down = (share[:, 1] * off[:, 1]).sum() / share[:, 1].sum()
    return float(np.median(length)), float(along), float(down)


def main(argv: Sequence[str] | None = None) -> None:
    """Print what matches of a scene are off by in common."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", choices=sorted(SCENES))
    parser.add_argument("options", nargs="*", metavar="key=value", help="options of flow")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--every", type=int, default=9, help="pictures from pair to pair")
    args = parser.parse_intermixed_args(argv)
    cv2.setNumThreads(1)
    given = OmegaConf.merge(OmegaConf.structured(FlowOptions), OmegaConf.from_dotlist(args.options))
    flow = FlowCorrespondence(OmegaConf.to_object(given))
    width, height = SCENES[args.scene].size
    known = Known(args.scene, args.seed, (320, round(320 * height / width) // 8 * 8), flow)
    print("| frames | pairs | median, px | along the flow | downwards, px |")
    print("| ---: | ---: | ---: | ---: | ---: |")
    for gap in GAPS:
        pairs = [known.errors(k, k + gap) for k in range(4, known.frames - max(GAPS), args.every)]
        for way, label in enumerate((f"{gap}", f"-{gap}")):
            each = np.array([biases(pair[way]) for pair in pairs])
            mean, error = each.mean(axis=0), each.std(axis=0) / np.sqrt(len(each))
            print(
                f"| {label} | {len(each)} | {mean[0]:.3f} | {100 * mean[1]:+.3f} ± "
                f"{100 * error[1]:.3f} % | {mean[2]:+.4f} ± {error[2]:.4f} |"
            )


if __name__ == "__main__":
    main()
