"""Rectification: raw pictures and their masks become working pictures and theirs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from droidw.errors import InputError
from droidw.geometry.camera import Camera
from droidw.geometry.sizes import SMALLEST, plan_size
from droidw.slam.frame import Frame, RawFrame  # records only: imports nothing at run time

__all__ = ["Rectification", "Rectifier"]

_Maps = tuple[npt.NDArray[np.int16], npt.NDArray[np.uint16]]


@dataclass(frozen=True)
class Rectification:
    """How raw pictures became working pictures: undistorted, resized and cropped.

    Attributes:
        raw: camera of the raw pictures.
        resized: size (width, height) of the whole picture at the scale of the working picture.
        corner: its pixel (x, y) that is the first of the working picture.
        size: working size (width, height).
    """

    raw: Camera
    resized: tuple[int, int]
    corner: tuple[int, int]
    size: tuple[int, int]

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able record."""
        return {**asdict(self), "raw": {**asdict(self.raw), "distortion": [*self.raw.distortion]}}

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> Rectification:
        """What `to_dict` wrote.

        Raises:
            KeyError, TypeError, ValueError: it is no such record.
            InputError: the camera is impossible.
        """
        raw = dict(record["raw"])
        coefficients = tuple(float(value) for value in raw.pop("distortion"))
        resized, corner, size = (
            (int(record[name][0]), int(record[name][1])) for name in ("resized", "corner", "size")
        )
        if min(*size, *resized) < 1 or min(corner) < 0:
            raise ValueError(f"impossible sizes: {resized}, {corner}, {size}")
        return cls(
            Camera(**raw, distortion=coefficients).validated("the record of the camera"),
            resized,
            corner,
            size,
        )

    @cached_property
    def maps(self) -> _Maps | None:
        """Look-up maps of the undistorted picture into the raw one; None where they are one."""
        return _undistortion_maps(self.raw) if self.raw.is_distorted else None

    def crop(self, picture: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The working part of a resized picture [H,W,...]."""
        left, top = self.corner
        return picture[top : top + self.size[1], left : left + self.size[0]]

    def shares(self, mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
        """Share [h,w] in [0,1] of each working pixel that a mask [H,W] of the raw picture marks.

        The mask may have any size; it shows the whole raw picture. What the lens did not see is
        not marked.
        """
        out = np.ascontiguousarray(mask, dtype=np.float32)
        if self.maps is not None:
            whole = (self.raw.width, self.raw.height)
            if out.shape[::-1] != whole:
                out = np.asarray(cv2.resize(out, whole, interpolation=cv2.INTER_NEAREST_EXACT))
            out = np.asarray(cv2.remap(out, *self.maps, cv2.INTER_LINEAR))
        height, width = out.shape
        if (width, height) != self.resized:
            shrinks = self.resized[0] <= width and self.resized[1] <= height
            mode = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST_EXACT
            out = np.asarray(cv2.resize(out, self.resized, interpolation=mode))
        return np.asarray(self.crop(out), dtype=np.float32)


class Rectifier:
    """Undistorts, resizes and crops pictures, each once and in this order; thread-safe.

    Undistortion happens at the raw size and keeps the intrinsics (REFERENCE 6.1); what the
    lens did not see becomes black. Resizing averages areas.

    Args:
        camera: of the raw pictures.
        long_side: working size by `working_size`, never enlarged, never stretched.
        size: working size (width, height) instead; the picture plus edges is then resized to it
            exactly, each axis by its own factor, as the published presets do.
        edge: pixels cropped off each side after resizing.
    Attributes:
        raw: camera of the raw pictures. camera: working camera, without distortion.
        way: how one becomes the other.
    Raises:
        InputError: the camera or the size is impossible.
        ValueError: neither or both of `long_side` and `size` are given.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        long_side: int | None = None,
        size: tuple[int, int] | None = None,
        edge: int = 0,
    ) -> None:
        self.raw = camera.validated("camera")
        if (long_side is None) == (size is None):
            raise ValueError("give either long_side or size")
        if size is not None:
            working = (int(size[0]), int(size[1]))
            resized = (working[0] + 2 * edge, working[1] + 2 * edge)
            if min(working) < SMALLEST:
                raise InputError(
                    f"a working size of {working[0]}x{working[1]} pixels is too small",
                    f"at least {SMALLEST} pixels are needed on each side (camera.size)",
                )
        else:
            assert long_side is not None
            resized, working = plan_size(camera.width, camera.height, long_side, edge, 8)
        corner = ((resized[0] - working[0]) // 2, (resized[1] - working[1]) // 2)
        self.way = Rectification(camera, resized, corner, working)
        self.camera = camera.undistorted().resized(*resized).cropped(*corner, *working)

    def rectify_image(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """The working picture [H,W,3] uint8 of a raw picture [H,W,3] uint8, contiguous.

        Raises:
            InputError: the picture has another size than the camera.
        """
        height, width = image.shape[:2]
        if (width, height) != (self.raw.width, self.raw.height):
            raise InputError(
                f"a picture of {width}x{height} pixels does not fit the camera of "
                f"{self.raw.width}x{self.raw.height} pixels"
            )
        out: npt.NDArray[np.uint8] = image
        if self.way.maps is not None:
            out = cv2.remap(out, *self.way.maps, cv2.INTER_LINEAR).astype(np.uint8, copy=False)
        if (width, height) != self.way.resized:
            shrinks = self.way.resized[0] <= width and self.way.resized[1] <= height
            mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            out = cv2.resize(out, self.way.resized, interpolation=mode).astype(np.uint8, copy=False)
        return np.ascontiguousarray(self.way.crop(out))

    def rectify_mask(
        self, mask: npt.NDArray[np.bool_], name: str = "", *, working: bool = False
    ) -> npt.NDArray[np.bool_]:
        """The mask [h,w] bool that lies on the working picture, from one of any size.

        It is enlarged or reduced to the raw picture without blending, and then goes the way of the
        picture. A mask of a working picture, or of the size of one alone, is laid on it as it is.

        Raises:
            InputError: the mask has another shape (ratio of its sides) than the picture.
        """
        height, width = mask.shape
        size, raw = (self.camera.width, self.camera.height), (self.raw.width, self.raw.height)
        as_it_is, shown = (width, height) == size != raw, raw
        if working:  # at its size, it was cropped to whole cells or not
            as_it_is = _stretch(mask, size) <= _stretch(mask, self.way.resized)
            shown = size if as_it_is else self.way.resized
        if (working or not as_it_is) and _stretch(mask, shown) > (0.05 if working else 0.02):
            raise InputError(
                f"a mask of {width}x{height} pixels{name and f' (picture {name})'} does not fit "
                f"pictures of {shown[0]}x{shown[1]} pixels",
                "masks may be of any size, but must show the whole picture: --masks DIR",
            )
        out = np.ascontiguousarray(mask, dtype=np.uint8)
        if as_it_is:
            return np.array(_nearest(out, size), dtype=bool)
        if self.way.maps is not None and not working:
            out = _nearest(out, raw)
            # Fixed-point maps know no nearest neighbour; what is more than half masked counts.
            out = np.asarray(cv2.remap(out * 255, *self.way.maps, cv2.INTER_LINEAR) > 127, np.uint8)
        return np.array(self.way.crop(_nearest(out, self.way.resized)), dtype=bool)

    def __call__(
        self, raw: RawFrame, mask: npt.NDArray[np.bool_] | None = None, *, working: bool = False
    ) -> Frame:
        """The frame at working size, image [3,H,W] float32 in [0,1], with its mask, if any.

        Args:
            working: whether the mask is of a working picture, without distortion and edges.
        Raises:
            InputError: as `rectify_image` and `rectify_mask`.
        """
        image = torch.from_numpy(self.rectify_image(raw.image))
        planes = image.permute(2, 0, 1).to(torch.float32).div_(255.0).contiguous()
        laid = None if mask is None else self.rectify_mask(mask, raw.name, working=working)
        ignored = None if laid is None else torch.from_numpy(laid)
        return Frame(raw.index, raw.time, planes, self.camera.intrinsics(), raw.name, ignored)


def _stretch(mask: npt.NDArray[np.bool_], size: tuple[int, int]) -> float:
    """By how much a mask has another ratio of sides than a size (width, height), as a share."""
    height, width = mask.shape
    return float(abs(width * size[1] / (height * size[0]) - 1.0))


def _nearest(mask: npt.NDArray[np.uint8], size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """A mask resized without blending, the pixel that lies under the centre of the new one."""
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint8)


def _undistortion_maps(
    camera: Camera,
) -> _Maps:
    """Fixed-point look-up maps of the undistorted picture into the raw one."""
    K = camera.matrix()
    size = (camera.width, camera.height)
    coefficients = np.array(camera.distortion, dtype=np.float64)
    library = cv2.fisheye if camera.model == "fisheye" else cv2
    first, second = library.initUndistortRectifyMap(
        K, coefficients, np.eye(3), K, size, cv2.CV_16SC2
    )
    return np.asarray(first, dtype=np.int16), np.asarray(second, dtype=np.uint16)
