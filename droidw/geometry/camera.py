"""Camera, grid and rectification: the one file that resizes, crops and knows the half pixel.

Pixel centres lie at integers, so an image of width W spans [-0.5, W - 0.5] and resizing to
width w moves a coordinate x to (x + 0.5) * w / W - 0.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.errors import InputError
from droidw.geometry.sizes import SMALLEST, plan_size, working_size
from droidw.slam.frame import Frame, RawFrame  # records only: imports nothing at run time

__all__ = ["Camera", "Grid", "Rectifier", "working_size"]

_COEFFICIENTS = {"pinhole": (0,), "opencv": (4, 5, 8), "fisheye": (4,)}


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: size and intrinsics in pixels, and lens distortion.

    Attributes:
        width, height: image size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels; pixel centres at integers.
        distortion: none for "pinhole"; k1 k2 p1 p2 [k3 [k4 k5 k6]] for "opencv" (the model of
            OpenCV's `undistort`); k1 k2 k3 k4 for "fisheye" (that of `cv2.fisheye`).
        model: which distortion model holds.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: Literal["pinhole", "opencv", "fisheye"] = "pinhole"

    @classmethod
    def guess(cls, width: int, height: int, fov_deg: float) -> Camera:
        """A pinhole camera with square pixels, a centred axis and this horizontal field of view.

        Raises:
            InputError: the field of view is not between 1 and 179 degrees.
        """
        if not 1.0 < fov_deg < 179.0:
            raise InputError(
                f"a field of view of {fov_deg:g} degrees is impossible",
                "valid: between 1 and 179 degrees; phones have about 65",
            )
        focal = 0.5 * width / math.tan(math.radians(fov_deg) / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def is_distorted(self) -> bool:
        """Whether pictures have to be undistorted.

        A fisheye lens bends straight lines even where all four coefficients are zero.
        """
        return self.model == "fisheye" or any(value != 0.0 for value in self.distortion)

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view in degrees, of the undistorted picture."""
        return math.degrees(2 * math.atan(0.5 * self.width / self.fx))

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the picture resized to this size, each axis by its own factor."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of the part of the picture that starts at pixel (left, top)."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def undistorted(self) -> Camera:
        """The pinhole camera with the same intrinsics."""
        return replace(self, distortion=(), model="pinhole")

    def intrinsics(self) -> Tensor:
        """fx, fy, cx, cy as float32 [4]."""
        return torch.tensor([self.fx, self.fy, self.cx, self.cy], dtype=torch.float32)

    def matrix(self) -> npt.NDArray[np.float64]:
        """The 3x3 matrix K that maps a point of the camera frame to homogeneous pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def validated(self, source: str) -> Camera:
        """Return the camera itself, if it can be one.

        Args:
            source: where the numbers come from, for the message ("calib.txt, line 1").
        Raises:
            InputError: a size, focal length, principal point or coefficient is impossible.
        """
        if self.width < 1 or self.height < 1:
            raise InputError(f"{source}: an image size of {self.width}x{self.height} is impossible")
        named = {"fx": self.fx, "fy": self.fy, "cx": self.cx, "cy": self.cy}
        named |= {f"distortion[{i}]": value for i, value in enumerate(self.distortion)}
        for name, value in named.items():
            if not math.isfinite(value):
                raise InputError(
                    f"{source}: {name} is {value}, not a finite number",
                    "give fx fy cx cy in pixels, e.g. 525 525 319.5 239.5, or leave the "
                    "calibration out: droidw then guesses one and says so",
                )
        for name in ("fx", "fy"):
            if named[name] <= 0:
                raise InputError(
                    f"{source}: {name} is {named[name]:g}, but a focal length is positive",
                    "give it in pixels; about the width of the picture is usual",
                )
        for name, value, size in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if not -0.5 <= value <= size - 0.5:
                raise InputError(
                    f"{source}: the principal point ({self.cx:g}, {self.cy:g}) lies outside the "
                    f"picture of {self.width}x{self.height} pixels",
                    f"{name} must be between -0.5 and {size - 0.5:g}; is the calibration for "
                    "another size, or are its numbers in another order than fx fy cx cy?",
                )
        if len(self.distortion) not in _COEFFICIENTS[self.model]:
            valid = " or ".join(str(n) for n in _COEFFICIENTS[self.model])
            raise InputError(
                f"{source}: {len(self.distortion)} distortion coefficients do not fit the "
                f"camera model '{self.model}'",
                f"valid: {valid} (opencv: k1 k2 p1 p2 [k3 [k4 k5 k6]]; fisheye: k1 k2 k3 k4)",
            )
        return self


@dataclass(frozen=True)
class Grid:
    """The grid of cells on an image: cell (x, y) lies at pixel stride * (x, y) + offset.

    Attributes:
        height, width: number of cells.
        stride: distance of cells in pixels.
        offset: pixel coordinate of the first cell, the same in x and y.
    """

    height: int
    width: int
    stride: int
    offset: float

    @classmethod
    def of(cls, image_height: int, image_width: int, stride: int, offset: float) -> Grid:
        """All cells whose centre lies in the image, between its first and last pixel centre.

        Raises:
            ValueError: stride or offset is impossible, or no cell fits.
        """
        if stride < 1 or offset < 0:
            raise ValueError(f"a grid needs stride >= 1 and offset >= 0, not {stride}, {offset}")
        height = math.floor((image_height - 1 - offset) / stride) + 1
        width = math.floor((image_width - 1 - offset) / stride) + 1
        if height < 1 or width < 1:
            raise ValueError(f"no cell of stride {stride} fits {image_width}x{image_height} pixels")
        return cls(height, width, stride, offset)

    def intrinsics(self, K: Tensor) -> Tensor:
        """Intrinsics [...,4] of the image as intrinsics [...,4] in cells of this grid."""
        focal = K[..., :2] / self.stride
        centre = (K[..., 2:] - self.offset) / self.stride
        return torch.cat([focal, centre], dim=-1)

    def centres(self) -> Tensor:
        """Pixel position of every cell, [h,w,2] float32, x then y."""
        x = torch.arange(self.width, dtype=torch.float32) * self.stride + self.offset
        y = torch.arange(self.height, dtype=torch.float32) * self.stride + self.offset
        yy, xx = torch.meshgrid(y, x, indexing="ij")
        return torch.stack([xx, yy], dim=-1)

    def sample(self, maps: Tensor, mode: Literal["bilinear", "nearest"] = "bilinear") -> Tensor:
        """Values [...,h,w] of image-sized maps [...,H,W] at the cells.

        "nearest" keeps the dtype and takes the upper left pixel of a tie, so that offset 3.5
        with stride 8 picks rows 3, 11, 19, ... as REFERENCE 2.4; "bilinear" returns floats.

        Raises:
            ValueError: the maps are too small for the grid.
        """
        last_y = (self.height - 1) * self.stride + self.offset
        last_x = (self.width - 1) * self.stride + self.offset
        if maps.shape[-2] - 1 < last_y or maps.shape[-1] - 1 < last_x:
            raise ValueError(f"maps of shape {tuple(maps.shape)} do not cover {self}")
        if mode == "nearest":
            start = math.ceil(self.offset - 0.5)
            return self._pick(maps, start, start).contiguous()
        if not maps.is_floating_point():
            maps = maps.float()
        # The stride is whole, so that every cell has the same four weights.
        start = math.floor(self.offset)
        part = self.offset - start
        if part == 0.0:
            return self._pick(maps, start, start).contiguous()
        top = torch.lerp(self._pick(maps, start, start), self._pick(maps, start, start + 1), part)
        low = torch.lerp(
            self._pick(maps, start + 1, start), self._pick(maps, start + 1, start + 1), part
        )
        return torch.lerp(top, low, part)

    def covered(self, mask: Tensor) -> Tensor:
        """Share [h,w] in [0,1] of each cell's `stride` x `stride` pixels that a mask marks.

        Args:
            mask: [H,W] bool at the size of the picture; its border goes on beyond its edges.
        """
        # The first pixel of the first cell, which may lie outside.
        start = math.ceil(self.offset - (self.stride - 1) / 2 - 0.5)
        first = max(-start, 0)
        border = (first, self.stride, first, self.stride)
        padded = F.pad(mask[None, None].float(), border, mode="replicate")
        shares = F.avg_pool2d(padded[..., start + first :, start + first :], self.stride)
        return shares[0, 0, : self.height, : self.width].contiguous()

    def _pick(self, maps: Tensor, top: int, left: int) -> Tensor:
        rows = slice(top, top + (self.height - 1) * self.stride + 1, self.stride)
        columns = slice(left, left + (self.width - 1) * self.stride + 1, self.stride)
        return maps[..., rows, columns]


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
        self._resized = resized
        self._left = (resized[0] - working[0]) // 2
        self._top = (resized[1] - working[1]) // 2
        self.camera = (
            camera.undistorted().resized(*resized).cropped(self._left, self._top, *working)
        )
        self._maps = _undistortion_maps(camera) if camera.is_distorted else None

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
        if self._maps is not None:
            out = cv2.remap(out, *self._maps, cv2.INTER_LINEAR).astype(np.uint8, copy=False)
        if (width, height) != self._resized:
            shrinks = self._resized[0] <= width and self._resized[1] <= height
            mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            out = cv2.resize(out, self._resized, interpolation=mode).astype(np.uint8, copy=False)
        return np.ascontiguousarray(self._crop(out))

    def _crop(self, picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        bottom, right = self._top + self.camera.height, self._left + self.camera.width
        return picture[self._top : bottom, self._left : right]

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
            as_it_is = _stretch(mask, size) <= _stretch(mask, self._resized)
            shown = size if as_it_is else self._resized
        if (working or not as_it_is) and _stretch(mask, shown) > (0.05 if working else 0.02):
            raise InputError(
                f"a mask of {width}x{height} pixels{name and f' (picture {name})'} does not fit "
                f"pictures of {shown[0]}x{shown[1]} pixels",
                "masks may be of any size, but must show the whole picture: --masks DIR",
            )
        out = np.ascontiguousarray(mask, dtype=np.uint8)
        if as_it_is:
            return np.array(_nearest(out, size), dtype=bool)
        if self._maps is not None and not working:
            out = _nearest(out, raw)
            # Fixed-point maps know no nearest neighbour; what is more than half masked counts.
            out = np.asarray(cv2.remap(out * 255, *self._maps, cv2.INTER_LINEAR) > 127, np.uint8)
        return np.array(self._crop(_nearest(out, self._resized)), dtype=bool)

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
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.uint16]]:
    """Fixed-point look-up maps of the undistorted picture into the raw one."""
    K = camera.matrix()
    size = (camera.width, camera.height)
    coefficients = np.array(camera.distortion, dtype=np.float64)
    library = cv2.fisheye if camera.model == "fisheye" else cv2
    first, second = library.initUndistortRectifyMap(
        K, coefficients, np.eye(3), K, size, cv2.CV_16SC2
    )
    return np.asarray(first, dtype=np.int16), np.asarray(second, dtype=np.uint16)
