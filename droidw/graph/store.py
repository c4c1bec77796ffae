"""The keyframe store: every per-keyframe quantity, declared once and moved together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from droidw.errors import PluginError
from droidw.geometry.camera import Grid
from droidw.geometry.transfer import upload
from droidw.interfaces.uncertainty import StoreField

__all__ = ["KeyframeInfo", "KeyframeStore"]

_FIRST_CAPACITY = 16


@dataclass
class KeyframeInfo:
    """What a keyframe has besides tensors.

    Attributes:
        index, time, name: of its frame.
        image: [H,W,3] uint8 RGB at working size.
        payload: what the correspondence op keeps; opaque.
        disp_full: [H,W] float32, or None where correspondence does not enlarge maps itself.
        lines: [n,4] float32 ends x, y, x, y of lines in the picture, pixels; None: not asked.
        whole: payload and field `unmasked` [h,w] of the whole picture, where something of it is
            hidden while it is tracked; else None.
    """

    index: int
    time: float
    name: str
    image: npt.NDArray[np.uint8]
    payload: Any
    disp_full: npt.NDArray[np.float32] | None = None
    lines: npt.NDArray[np.float32] | None = None
    whole: tuple[Any, Tensor] | None = None


class KeyframeStore:
    """Grows as needed; `remove` moves every declared field by construction.

    Core fields, each [N,...] and returned as views into the storage:
        T_cw [7] world to camera; disps [h,w] inverse depth; prior [h,w] inverse depth of the
        depth prior (0: none); features [c,h,w]; uncertainty [h,w]; damping [h,w] learned;
        unmasked [h,w] in [0,1], what the user's mask leaves of a cell and its neighbours; movable
        [h,w] in [0,1], how likely features find what can move by itself (0: not asked); through
        [h,w] in [0,1], how much others see through a cell (0: not asked); axes [3,3] rotation from
        the axes of the scene to the camera, by the lines in the picture, and axes_information [3,3]
        of a tangent vector on the left of it (0: not known), float64.

    Args:
        grid: the grid on which maps live.
        intrinsics: [4] fx, fy, cx, cy of the working image, in pixels.
        feature_dim: channels of the feature extractor (0: none).
        fields: further per-keyframe tensors that parts asked for.
        device: where tensors live.
        feature_dtype: precision in which features are held.
    """

    def __init__(
        self,
        grid: Grid,
        intrinsics: Tensor,
        feature_dim: int = 0,
        fields: Sequence[StoreField] = (),
        device: torch.device | str = "cpu",
        feature_dtype: torch.dtype = torch.float32,
    ) -> None:
        self.grid = grid
        self.device = torch.device(device)
        self.image_intrinsics = intrinsics.to(self.device)
        self.intrinsics = grid.intrinsics(self.image_intrinsics)
        self.infos: list[KeyframeInfo] = []
        core = (
            StoreField("T_cw", (7,)),
            StoreField("disps", ("h", "w"), fill=1.0),
            StoreField("prior", ("h", "w")),
            StoreField("features", ("c", "h", "w"), dtype=str(feature_dtype).split(".")[-1]),
            StoreField("uncertainty", ("h", "w")),
            StoreField("damping", ("h", "w"), fill=1e-6),
            StoreField("unmasked", ("h", "w"), fill=1.0),
            StoreField("movable", ("h", "w")),
            StoreField("through", ("h", "w")),
            StoreField("axes", (3, 3), dtype="float64"),
            StoreField("axes_information", (3, 3), dtype="float64"),
        )
        self._declared: dict[str, StoreField] = {}
        sizes = {"h": grid.height, "w": grid.width, "c": feature_dim}
        for declared in (*core, *fields):
            if declared.name in self._declared:
                raise PluginError(
                    f"the uncertainty model breaks its contract: the store field "
                    f"'{declared.name}' is there already",
                    f"give it a name of its own; taken: {', '.join(self._declared)}",
                )
            self._declared[declared.name] = declared
        self._data: dict[str, Tensor] = {}
        for name, declared in self._declared.items():
            shape = tuple(sizes[s] if isinstance(s, str) else s for s in declared.shape)
            self._data[name] = self._filled(declared, (_FIRST_CAPACITY, *shape))
        self._own = tuple(declared.name for declared in fields)

    def _filled(self, declared: StoreField, shape: tuple[int, ...]) -> Tensor:
        dtype = getattr(torch, declared.dtype)
        return torch.full(shape, declared.fill, dtype=dtype, device=self.device)

    def __len__(self) -> int:
        return len(self.infos)

    def __getitem__(self, name: str) -> Tensor:
        """Field `name` of all keyframes, [N,...], a view."""
        return self._data[name][: len(self.infos)]

    @property
    def names(self) -> frozenset[str]:
        """Of all fields."""
        return frozenset(self._declared)

    @property
    def T_cw(self) -> Tensor:
        """[N,7] world to camera."""
        return self["T_cw"]

    @property
    def disps(self) -> Tensor:
        """[N,h,w] inverse depth."""
        return self["disps"]

    def extra(self) -> dict[str, Tensor]:
        """Views of the fields that parts asked for."""
        return {name: self[name] for name in self._own}

    def blank(self) -> KeyframeStore:
        """A store for keyframes of the same camera with the same fields, without any yet."""
        features = self._data["features"]
        own = [self._declared[name] for name in self._own]
        store = KeyframeStore(
            self.grid,
            self.image_intrinsics,
            features.shape[1],
            own,
            self.device,
            features.dtype,
        )
        store.intrinsics = self.intrinsics.clone()
        return store

    def values(self, index: int) -> dict[str, Tensor]:
        """All fields of keyframe `index`, views."""
        return {name: self[name][index] for name in self._declared}

    def append(self, info: KeyframeInfo, **values: Tensor) -> int:
        """Add a keyframe and return its number; fields not given hold their fill value."""
        n = len(self.infos)
        for name, declared in self._declared.items():
            data = self._data[name]
            if n == data.shape[0]:
                grown = self._filled(declared, (2 * n, *data.shape[1:]))
                grown[:n] = data
                self._data[name] = data = grown
            if name in values:
                data[n] = values[name]
            else:
                data[n].fill_(declared.fill)
        self.infos.append(info)
        return n

    def remove(self, index: int) -> None:
        """Delete keyframe `index`; later ones move up by one, with all their fields."""
        n = len(self.infos)
        if not 0 <= index < n:
            raise IndexError(f"keyframe {index} of {n}")
        for data in self._data.values():
            data[index : n - 1] = data[index + 1 : n].clone()
        del self.infos[index]

    def sort(self) -> None:
        """Bring keyframes into the order of their frames, with all their fields."""
        n = len(self.infos)
        order = sorted(range(n), key=lambda k: self.infos[k].index)
        at = upload(torch.tensor(order, dtype=torch.int64), self.device)
        for data in self._data.values():
            data[:n] = data[at]
        self.infos[:] = [self.infos[k] for k in order]

    def write(self, T_cw: Tensor, disps: Tensor) -> None:
        """Replace poses and disparities of all keyframes."""
        self.T_cw.copy_(T_cw)
        self.disps.copy_(disps)

    def payload(self, index: int) -> Any:
        """The correspondence payload of keyframe `index`."""
        return self.infos[index].payload

    def times(self) -> list[float]:
        """Times of all keyframes in seconds."""
        return [info.time for info in self.infos]
