"""Poses and depths of all keyframes, held apart from the store that they are of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from torch import Tensor

from droidw.geometry.se3 import chained, exp, inv, log, mul
from droidw.slam.doubt import Link

if TYPE_CHECKING:
    from droidw.graph.store import KeyframeStore

__all__ = ["Path"]

# By how much, in logarithms, an inverse depth may change at most where a path goes on beyond what
# was found.
_FARTHEST = 1.0


@dataclass(frozen=True)
class Path:
    """What a way of tracking the keyframes found of them.

    Attributes:
        T_cw: [N,7] world to camera. disps: [N,h,w] inverse depth.
        damping: [N,h,w] as correspondence gave it.
        full: of each keyframe, as `KeyframeInfo.disp_full`.
        agreement: share of what was measured that agrees, see `explained_share`; NaN if unknown.
        weakest: where least of it agrees, see `weakest_link`.
    """

    T_cw: Tensor
    disps: Tensor
    damping: Tensor
    full: tuple[Any, ...]
    agreement: float = float("nan")
    weakest: Link = Link()

    @classmethod
    def of(
        cls, store: KeyframeStore, agreement: float = float("nan"), weakest: Link | None = None
    ) -> Path:
        """Copies of what a store holds now."""
        return cls(
            store.T_cw.clone(),
            store.disps.clone(),
            store["damping"].clone(),
            tuple(info.disp_full for info in store.infos),
            agreement,
            weakest or Link(),
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

    def beyond(self, before: Path, share: float) -> Path:
        """A path that goes on from this one as it has come from `before`.

        Motions between keyframes go on as twists, inverse depths by their ratios.

        Args:
            before: of the same keyframes. share: how far to go, of the way from there to here.
        """
        motions, earlier = self.motions(), before.motions()
        onward = mul(exp(share * log(mul(motions, inv(earlier)))), motions)
        grown = (self.disps / before.disps).log().mul(share).clamp(-_FARTHEST, _FARTHEST)
        disps = self.disps * grown.nan_to_num(0.0).exp()
        return replace(self, T_cw=chained(onward, self.T_cw[0]), disps=disps)

    def motions(self) -> Tensor:
        """From each keyframe to the next, [N-1,7]."""
        return mul(self.T_cw[1:], inv(self.T_cw[:-1]))

    def write_to(self, store: KeyframeStore) -> None:
        """Let a store of the same keyframes have this."""
        store.write(self.T_cw, self.disps)
        store["damping"].copy_(self.damping)
        for info, full in zip(store.infos, self.full, strict=True):
            info.disp_full = full
