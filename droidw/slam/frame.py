"""The records that flow through a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.geometry.camera import Camera
    from droidw.geometry.rectify import Rectification

__all__ = [
    "CloudPoints", "Frame", "KeyframeRecord", "RawFrame", "RunResult", "Trajectory", "is_blank",
]  # fmt: skip

# Standard deviation of the strongest colour channel of a picture below which it shows nothing.
_BLANK = 0.02


@dataclass(frozen=True)
class RawFrame:
    """One picture as a reader delivers it, before undistortion and resizing.

    Attributes:
        index: position in the source, counted from 0 over all pictures, readable or not.
        time: seconds, float64; presentation time of a video, stamp of a dataset.
        image: [H,W,3] uint8, RGB.
        name: file name or other label, for messages and exporters.
    """

    index: int
    time: float
    image: npt.NDArray[np.uint8]
    name: str = ""


def is_blank(image: Tensor) -> bool:
    """Whether a picture [3,H,W] in [0,1] shows too little to learn anything from."""
    return image.numel() > 0 and float(image.flatten(1).std(1).max()) < _BLANK


@dataclass(frozen=True)
class Frame:
    """One picture at working size: undistorted, resized and cropped once.

    Attributes:
        index: position in the source.
        time: seconds, float64.
        image: [3,H,W] float32 in [0,1], RGB.
        intrinsics: [4] float32 fx, fy, cx, cy in pixels of `image`; pixel centres at integers.
        name: label of the raw frame.
        mask: [H,W] bool, True where the user wants the picture ignored; None: nowhere.
    """

    index: int
    time: float
    image: Tensor
    intrinsics: Tensor
    name: str = ""
    mask: Tensor | None = None

    @property
    def is_blank(self) -> bool:
        """Whether the picture shows next to nothing: black, a cap on the lens."""
        return is_blank(self.image)


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time, as written to files.

    Attributes:
        times: [N] float64, seconds.
        T_wc: [N,7] float64, camera to world, translation then unit quaternion xyzw.
        is_keyframe: [N] bool, or empty where unknown.
    """

    times: npt.NDArray[np.float64]
    T_wc: npt.NDArray[np.float64]
    is_keyframe: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __len__(self) -> int:
        return len(self.times)

    @property
    def centres(self) -> npt.NDArray[np.float64]:
        """Camera centres in the world, [N,3]."""
        return self.T_wc[:, :3]


@dataclass(frozen=True)
class KeyframeRecord:
    """One keyframe of a finished run, on the CPU.

    Attributes:
        index, time, name: of its frame.
        image: [H,W,3] uint8 RGB at working size.
        T_wc: [7] float64, camera to world.
        intrinsics: [4] float64 at working size.
        disp: [h,w] float32 inverse depth on the grid, 1/scene-unit.
        depth_valid: [h,w] bool, depth seen consistently by other keyframes.
        uncertainty: [h,w] float32, larger means less static.
        weight: [h,w] float32 in [0,1], what uncertainty left of the weight in BA.
        disp_full: [H,W] float32, or None where correspondence has no upsampling of its own.
    """

    index: int
    time: float
    name: str
    image: npt.NDArray[np.uint8]
    T_wc: npt.NDArray[np.float64]
    intrinsics: npt.NDArray[np.float64]
    disp: npt.NDArray[np.float32]
    depth_valid: npt.NDArray[np.bool_]
    uncertainty: npt.NDArray[np.float32]
    weight: npt.NDArray[np.float32]
    disp_full: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True)
class CloudPoints:
    """A coloured point cloud in the world frame: xyz [N,3] float32, rgb [N,3] uint8."""

    xyz: npt.NDArray[np.float32]
    rgb: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class RunResult:
    """What a run leaves, read-only, for exporters and the report.

    Attributes:
        trajectory: every input frame that was read.
        keyframes: in time order.
        cloud: static points of all keyframes.
        camera: the working camera (size and intrinsics after resizing).
        stride, offset: the grid: cell (x, y) lies at pixel stride * (x, y) + offset.
        source: what was run on; truth: ground-truth trajectory if the source has one.
        manifest: facts of the run (versions, timings, assumptions), JSON-able.
        warnings: sentences.
        rectification: how raw pictures became working pictures, if that is known.
    """

    trajectory: Trajectory
    keyframes: tuple[KeyframeRecord, ...]
    cloud: CloudPoints
    camera: Camera
    stride: int
    offset: float
    source: str
    truth: Trajectory | None = None
    manifest: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    run_dir: Path | None = None
    rectification: Rectification | None = None
