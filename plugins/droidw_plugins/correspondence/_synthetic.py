"""Implementation of correspondence `synthetic`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from droidw.interfaces.correspondence import EdgeRequest, EdgeUpdate, Motion, Purpose
from droidw.testing.scenes import Scene, named_spec

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.geometry.camera import Grid
    from droidw.slam.frame import Frame
    from droidw_plugins.correspondence.synthetic import SyntheticCorrespondenceOptions

__all__ = ["SyntheticCorrespondence", "SyntheticPayload", "SyntheticSession"]

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SyntheticPayload:
    """Which picture of the scene a frame is, and how its working picture lies in the scene's.

    Attributes:
        index: frame of the scene.
        cells: [h,w,2] pixels of the scene's picture where the grid's cells lie.
        intrinsics: [4] of the working picture. size: its width and height.
        grid: grid of the working picture.
    """

    index: int
    cells: Floats
    intrinsics: Floats
    size: tuple[int, int]
    grid: Grid


class SyntheticCorrespondence:
    """Exact positions of grid cells in other frames; what moves is followed as it moves.

    Cells that are hidden in the other frame or outside its working picture get confidence 0.
    Noise and outliers depend on the seed and the pair of frames alone, not on the order of asking.

    Args:
        options: the scene and what spoils the answers. seed: of noise and outliers.
    """

    def __init__(self, options: SyntheticCorrespondenceOptions, seed: int = 0) -> None:
        self.stride = options.stride
        self.offset = (options.stride - 1) / 2
        self.options = options
        self.scene = Scene(
            named_spec(
                options.scene,
                width=options.width,
                height=options.height,
                frames=options.frames,
                fps=options.fps,
                seed=options.seed,
            )
        )
        self._seed = seed

    def encode(self, frame: Frame, grid: Grid) -> SyntheticPayload:
        """Note the frame's number and its geometry; the picture itself is not looked at.

        Raises:
            UsageError: the scene has no such frame.
        """
        self.scene.T_wc(frame.index)
        K = frame.intrinsics.detach().cpu().numpy().astype(np.float64)
        K_scene = self.scene.intrinsics
        centres = grid.centres().numpy().astype(np.float64)
        cells = (centres - K[2:]) / K[:2] * K_scene[:2] + K_scene[2:]
        height, width = frame.image.shape[-2:]
        return SyntheticPayload(frame.index, cells, K, (width, height), grid)

    def context(self, payload: Any, frame: Frame, grid: Grid) -> Any:
        """Nothing more is needed of a keyframe."""
        return payload

    def motion(self, reference: Any, current: Any) -> Motion:
        """Median length of the true flow of the visible cells, without noise."""
        target, visible = self.exact(reference, current)
        if not visible.any():
            return Motion(0.0, 0.0)
        grid = reference.grid
        y, x = np.mgrid[: grid.height, : grid.width].astype(np.float64)
        length = np.linalg.norm(target - np.stack([x, y], axis=-1), axis=-1)
        return Motion(float(np.median(length[visible])), float(visible.mean()))

    def session(self, purpose: Purpose = "window") -> SyntheticSession:
        """Fresh edge state: it remembers the answer of each edge until it is forgotten."""
        return SyntheticSession(self)

    def exact(
        self,
        source: SyntheticPayload,
        target: SyntheticPayload,
    ) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """True position of each cell of `source` in `target` [h,w,2], cells; and visibility."""
        found = self.scene.correspond(source.index, target.index, source.cells)
        K_scene, K = self.scene.intrinsics, target.intrinsics
        pixels = (found.target - K_scene[2:]) / K_scene[:2] * K[:2] + K[2:]
        width, height = target.size
        inside = ((pixels >= 0) & (pixels <= [width - 1, height - 1])).all(axis=-1)
        return (pixels - target.grid.offset) / target.grid.stride, found.visible & inside

    def measure(self, source: SyntheticPayload, target: SyntheticPayload) -> tuple[Tensor, Tensor]:
        """Position [h,w,2] and confidence [h,w,2], float32, with noise and outliers."""
        o = self.options
        position, visible = self.exact(source, target)
        if o.noise_px > 0 or o.outlier_share > 0:
            rng = np.random.default_rng([self._seed, 31, source.index, target.index])
            position = position + rng.standard_normal(position.shape) * o.noise_px / self.stride
            wrong = rng.random(visible.shape) < o.outlier_share
            error = rng.uniform(-o.outlier_px, o.outlier_px, position.shape) / self.stride
            position = np.where(wrong[..., None], position + error, position)
        confidence = np.repeat(visible[..., None] * o.confidence, 2, axis=-1)
        return (
            torch.from_numpy(position.astype(np.float32)),
            torch.from_numpy(confidence.astype(np.float32)),
        )


class SyntheticSession:
    """The answers given so far, by edge id."""

    def __init__(self, owner: SyntheticCorrespondence) -> None:
        self._owner = owner
        self._known: dict[int, tuple[Tensor, Tensor]] = {}

    def update(self, request: EdgeRequest) -> EdgeUpdate:
        """Answer each edge; `coords` is not needed to know the truth."""
        device = request.coords.device
        for name, i, j in zip(request.ids, request.ii, request.jj, strict=True):
            if name not in self._known:
                self._known[name] = self._owner.measure(request.payload(i), request.payload(j))
        if not request.ids:
            empty = request.coords.to(torch.float32)
            return EdgeUpdate(empty.clone(), empty.clone())
        answers = [self._known[name] for name in request.ids]
        return EdgeUpdate(
            torch.stack([target for target, _ in answers]).to(device),
            torch.stack([confidence for _, confidence in answers]).to(device),
        )

    def forget(self, ids: list[int]) -> None:
        """Drop these edges; unknown ids are ignored."""
        for name in ids:
            self._known.pop(name, None)
