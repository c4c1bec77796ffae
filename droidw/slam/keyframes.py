"""Keyframes made of frames: what the store and the parts hold of each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from droidw.graph.store import KeyframeInfo
from droidw.interfaces.uncertainty import Renews

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.slam.cell_maps import CellMaps
    from droidw.slam.motion_filter import Encoded
    from droidw.slam.optimise import Optimiser

__all__ = ["Keyframes"]


class Keyframes:
    """Adds keyframes to the store of an optimiser, and tells uncertainty and lines of them.

    Args:
        optimiser: of the run. maps: asked for what was not made ahead.
        renews: uncertainty is told what can move in every keyframe that is appended.
    """

    def __init__(self, optimiser: Optimiser, maps: CellMaps, renews: bool) -> None:
        self._optimiser = optimiser
        self._maps = maps
        self._renews = renews

    def append(self, current: Encoded, pose: Tensor, disp: Tensor) -> int:
        """Add a keyframe behind all others, with pose [7] and inverse depth [h,w]; its number."""
        optimiser, movable = self._optimiser, current.movable
        number = self._put(current, {"T_cw": pose, "disps": disp})
        with optimiser.clock("uncertainty"):
            view, model = optimiser.view(), optimiser.parts.uncertainty
            begun = self._renews and optimiser.begun
            if begun and isinstance(model, Renews) and movable is not None:
                model.renew(view, number, movable)
            model.append(view, number)
        optimiser.upright.see(number)
        return number

    def insert(self, made: Sequence[tuple[Encoded, dict[str, Tensor]]]) -> list[int]:
        """Add keyframes at their places between others, with these fields; their numbers.

        What can move is known by then, so that uncertainty is not told of that.
        """
        optimiser, store = self._optimiser, self._optimiser.store
        for current, known in made:
            self._put(current, known)
        store.sort()
        indices = {current.frame.index for current, _ in made}
        numbers = [k for k, info in enumerate(store.infos) if info.index in indices]
        for number in numbers:
            with optimiser.clock("uncertainty"):
                optimiser.parts.uncertainty.append(optimiser.view(), number)
            optimiser.upright.see(number)
        return numbers

    def _put(self, current: Encoded, known: dict[str, Tensor]) -> int:
        frame, maps, plain = current.frame, self._maps, current.plain
        pixels = (frame.image.permute(1, 2, 0) * 255.0 + 0.5).clamp(0, 255).byte()
        info = KeyframeInfo(
            frame.index, frame.time, frame.name, pixels.cpu().numpy(), current.context
        )
        if plain is not None:
            info.whole = plain.context, maps.unmasked(plain.frame)
        known = {
            **known,
            "features": maps.features(frame) if current.features is None else current.features,
            "prior": maps.prior(frame) if current.prior is None else current.prior,
            "unmasked": maps.unmasked(frame),
        }
        if current.movable is not None:
            known["movable"] = current.movable
        return self._optimiser.store.append(info, **known)
