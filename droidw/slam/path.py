"""Poses and depths of all keyframes, held apart from the store that they are of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from torch import Tensor

from droidw.geometry.se3 import inv, mul

if TYPE_CHECKING:
    from droidw.graph.store import KeyframeStore

__all__ = ["Path"]


@dataclass(frozen=True)
class Path:
    """What a way of tracking the keyframes found of them.

    Attributes:
        T_cw: [N,7] world to camera. disps: [N,h,w] inverse depth.
        damping: [N,h,w] as correspondence gave it.
        full: of each keyframe, as `KeyframeInfo.disp_full`.
        agreement: share of what was measured that agrees, see `explained_share`; NaN if unknown.
    """

    T_cw: Tensor
    disps: Tensor
    damping: Tensor
    full: tuple[Any, ...]
    agreement: float = float("nan")

    @classmethod
    def of(cls, store: KeyframeStore, agreement: float = float("nan")) -> Path:
        """Copies of what a store holds now."""
        return cls(
            store.T_cw.clone(),
            store.disps.clone(),
            store["damping"].clone(),
            tuple(info.disp_full for info in store.infos),
            agreement,
        )

    def turned(self, first: Tensor) -> Path:
        """The same with keyframes last first, the first of them at pose `first` [7]."""
        T_cw = self.T_cw.flip(0)
        return replace(
            self,
            T_cw=mul(mul(T_cw, inv(T_cw[:1])), first[None]),
            disps=self.disps.flip(0),
            damping=self.damping.flip(0),
            full=self.full[::-1],
        )

    def write_to(self, store: KeyframeStore) -> None:
        """Let a store of the same keyframes have this."""
        store.write(self.T_cw, self.disps)
        store["damping"].copy_(self.damping)
        for info, full in zip(store.infos, self.full, strict=True):
            info.disp_full = full
