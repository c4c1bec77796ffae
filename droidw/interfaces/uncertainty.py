"""Uncertainty models: which pixels cannot be trusted to be static."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "Begins",
    "Indices",
    "Renews",
    "StoreField",
    "UncertaintyModel",
    "UncertaintyReport",
    "UncertaintyView",
]


@dataclass(frozen=True)
class StoreField:
    """A tensor that a part wants to keep per keyframe; it moves and dies with the keyframe.

    Attributes:
        name: unique within the store.
        shape: per keyframe, in which "h", "w" and "c" stand for the grid and the feature size.
        fill: initial value.
        dtype: name of a torch dtype.
    """

    name: str
    shape: tuple[int | str, ...]
    fill: float = 0.0
    dtype: str = "float32"


@dataclass(frozen=True)
class Indices:
    """Edges (ii[n], jj[n]) and frames on the host."""

    ii: Sequence[int]
    jj: Sequence[int]
    frames: Sequence[int]


@dataclass(frozen=True)
class UncertaintyView:
    """What a model may see: views into the keyframe store and the current edges.

    Attributes:
        features: [N,c,h,w], may be half precision; c is 0 with extractor `none`.
        uncertainty: [N,h,w] float32; the model's output, written in place.
        fields: the model's own `StoreField`s by name, [N,...], written in place.
        T_cw: [N,7] world to camera. disps: [N,h,w]. intrinsics: [4] of the grid.
        ii, jj: [E] int64 edges given to this bundle adjustment call.
        target: [E,h,w,2] measured correspondence in cells.
        confidence: [E,h,w,2] or [E,h,w,3], the information of these as in `EdgeUpdate`; the mean of
            the first two channels says how sure a match is on the whole.
        frames: [K] int64 keyframes whose maps are to be refreshed.
        iteration: counts updates since the start of the run.
        host: `ii`, `jj` and `frames` once more as lists; see `indices`.
        gate: the weights in [0,1] that uncertainties [N,h,w] leave; None: all of it.
        calibrate: similarities of these features are to be brought to the scale on which
            thresholds are meant (docs/features.md); false: their cosine is taken as it is.
        mended: poses and depths have been through a pass of global adjustment, after which a model
            that `begins` has begun anew, and nothing has put them in doubt.
    """

    features: Tensor
    uncertainty: Tensor
    fields: Mapping[str, Tensor]
    T_cw: Tensor
    disps: Tensor
    intrinsics: Tensor
    ii: Tensor
    jj: Tensor
    target: Tensor
    confidence: Tensor
    frames: Tensor
    iteration: int = 0
    gate: Callable[[Tensor], Tensor] | None = None
    calibrate: bool = False
    mended: bool = False
    host: Indices | None = None

    def indices(self) -> Indices:
        """`ii`, `jj` and `frames` as lists, without asking a GPU if the core has given them."""
        if self.host is not None:
            return self.host
        return Indices(self.ii.tolist(), self.jj.tolist(), self.frames.tolist())


@dataclass(frozen=True)
class UncertaintyReport:
    """Facts of one update: energy before the step and whatever else the model measures."""

    energy: float = 0.0
    facts: dict[str, float] = field(default_factory=dict)


@runtime_checkable
class UncertaintyModel(Protocol):
    """Maps evidence to an uncertainty u >= 0 per cell; the core's gate turns u into a weight.

    Attributes:
        fields: tensors that the model keeps per keyframe.

    One that `Begins`, and perhaps `Renews`, is told what can move before any motion is known.
    """

    fields: tuple[StoreField, ...]

    def append(self, view: UncertaintyView, index: int) -> None:
        """Write `view.uncertainty[index]` (and own fields) for a new keyframe.

        It is the last one, or came in between others, which moved up by then with all their fields.
        `view.ii`, `jj`, `target` and `confidence` are empty here.
        """
        ...

    def update(self, view: UncertaintyView) -> UncertaintyReport:
        """One step of the model on these edges; refreshes the maps of `view.frames`."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """What is global to the model (parameters), for checkpoints and the manifest."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict()`."""
        ...


@runtime_checkable
class Begins(Protocol):
    """What a model may offer besides: to start from what can move, before any motion is known.

    It is asked only with an extractor that `KnowsMovable`.

    Attributes:
        begins: whether this model wants it.
    """

    begins: bool

    def begin(self, view: UncertaintyView, movable: Tensor) -> None:
        """Give up what was learned, and write `view.uncertainty` of `view.frames`.

        Called before the first search, with the keyframes of the initialisation, and again in
        global adjustment, with all of them.

        Args:
            view: without edges.
            movable: [N,h,w] in [0,1], what the extractor's `movable` says of every keyframe.
        """
        ...


@runtime_checkable
class Renews(Protocol):
    """What a model that `Begins` may offer besides: to be told of every later keyframe, too.

    Attributes:
        renews: whether this model wants it.
    """

    renews: bool

    def renew(self, view: UncertaintyView, index: int, movable: Tensor) -> None:
        """Take note of what can move in a keyframe, just before its `append`; writes no map.

        Args:
            view: without edges.
            index: number of the keyframe.
            movable: [h,w] in [0,1] of it.
        """
        ...
