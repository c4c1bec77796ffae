"""Camera and grid: the one file that knows the half pixel.

Pixel centres lie at integers, so an image of width W spans [-0.5, W - 0.5] and resizing to
width w moves a coordinate x to (x + 0.5) * w / W - 0.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.errors import InputError

__all__ = ["Camera", "Grid"]

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
