"""Correspondence: where the cells of one keyframe lie in another, and how surely."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, runtime_checkable

if TYPE_CHECKING:
    import numpy.typing as npt
    from torch import Tensor

    from droidw.geometry.camera import Grid
    from droidw.slam.frame import Frame

__all__ = [
    "Correspondence",
    "EdgeRequest",
    "EdgeSession",
    "EdgeUpdate",
    "FindsLines",
    "MatchesPoints",
    "Motion",
    "Purpose",
    "SetsAside",
    "Upsamples",
]

Array: TypeAlias = "npt.NDArray[Any]"
Purpose = Literal["window", "global", "fill"]


@dataclass(frozen=True)
class Motion:
    """How far the picture moved between two frames.

    Attributes:
        flow: length of the flow in grid cells that the bulk of the matched cells has; close to
            zero for a camera at rest even while something moves in front of it.
        matched: share of cells in [0,1] that could be matched.
    """

    flow: float
    matched: float


@dataclass(frozen=True)
class EdgeRequest:
    """A question for one round of correspondence over E directed edges i -> j.

    Attributes:
        ids: E numbers that name the edges for as long as a session lives; an id that the
            session has not seen is a new edge.
        ii, jj: E node numbers, arguments of `payload`.
        coords: [E,h,w,2] where the current poses and depths put each cell of i in j, in cells
            of j's grid, x then y; finite everywhere.
        valid: [E,h,w] bool, whether `coords` means anything (in front of the camera).
        payload: node number -> what `encode`/`context` returned for that frame.
        informed: whether poses and depths are good enough to search around `coords`.
        gates: node numbers -> [n,h,w] in [0,1], what learned uncertainty leaves of their cells;
            None where it is not known or not to be used.
        doubtful: whether a path is tracked again because too little of what was measured agreed
            with it: worth a search that takes longer and relies less on the prediction.
    """

    ids: list[int]
    ii: list[int]
    jj: list[int]
    coords: Tensor
    valid: Tensor
    payload: Callable[[int], Any]
    informed: bool = True
    gates: Callable[[Sequence[int]], Tensor] | None = None
    doubtful: bool = False


@dataclass(frozen=True)
class EdgeUpdate:
    """The answer, in the order of the request.

    Attributes:
        target: [E,h,w,2] float32, measured position of each cell of i in j, cells, x then y.
        confidence: [E,h,w,2] (xx, yy) or [E,h,w,3] (xx, yy, xy) float32, the information
            [[xx, xy], [xy, yy]] of the position: xx, yy >= 0, the weights of x and of y, and
            |xy| <= sqrt(xx yy) but for rounding; two channels mean xy = 0 (docs/conventions.md).
            The scale belongs to the correspondence and is matched by the preset's damping.
        damping: [U,h,w] learned depth damping of the source frames, or None.
        sources: the U node numbers of `damping` and `upmask`, ascending, or None.
        upmask: [U,576,h,w] convex upsampling mask, or None.
    """

    target: Tensor
    confidence: Tensor
    damping: Tensor | None = None
    sources: list[int] | None = None
    upmask: Tensor | None = None


@runtime_checkable
class EdgeSession(Protocol):
    """The state of the edges of one factor graph; one for "global" may be one that `Upsamples`."""

    def update(self, request: EdgeRequest) -> EdgeUpdate:
        """One round: measure new edges, refine or re-use the old ones."""
        ...

    def forget(self, ids: list[int]) -> None:
        """Drop the state of these edges; unknown ids are ignored."""
        ...


@runtime_checkable
class Upsamples(Protocol):
    """What a session may offer besides: maps at the full size of the picture."""

    def upsample(self, node: int, disp: Tensor) -> Tensor | None:
        """The map of a source frame of the last update, finer.

        Args:
            node: number of the frame.
            disp: [h,w] inverse depth of its cells.
        Returns:
            [H,W]; None where nothing is known of how to make it.
        """
        ...


@runtime_checkable
class Correspondence(Protocol):
    """Measures dense correspondence on a regular grid of cells.

    An operator with a recurrent state (`droid`) moves its target at every `update`; one that
    measures (`flow`) computes an edge once, and again when the prediction has moved away from
    where it started. Both are the same to the core.

    Besides it may be one that `MatchesPoints`, `SetsAside` or `FindsLines`; the core does without
    what is not there.

    Attributes:
        stride, offset: the grid: cell (x, y) lies at pixel `stride * (x, y) + offset`.
    """

    stride: int
    offset: float

    def encode(self, frame: Frame, grid: Grid) -> Any:
        """What is needed of every frame; opaque to the core, cheap to hold.

        Where footage is tracked once more, frames are encoded twice: as they are, and with a mask
        over what was found to move. `context` is asked of both, in this order. What is held by
        the index of a frame has to tell them apart.

        Raises:
            InputError: pictures of this size cannot be taken; says which can.
        """
        ...

    def context(self, payload: Any, frame: Frame, grid: Grid) -> Any:
        """What is needed in addition of a keyframe; may return `payload` itself."""
        ...

    def motion(self, reference: Any, current: Any) -> Motion:
        """How far the picture moved from `reference` to `current` (payloads).

        Called in the order of the frames, so that a part may go by the motion so far. Where the
        component has the capability "threads", or "gpu-threads" and the run is on a GPU, `encode`,
        `motion` and `context` are called ahead of time from one other thread than sessions are,
        on a GPU with a stream of its own as the current one.
        """
        ...

    def session(self, purpose: Purpose = "window") -> EdgeSession:
        """Fresh edge state for one graph.

        Args:
            purpose: "window" for the sliding window; "global" for very many edges, where
                memory counts; "fill" for motion-only edges from keyframes to other frames,
                each asked for in one direction.
        """
        ...


@runtime_checkable
class MatchesPoints(Protocol):
    """What correspondence may offer besides: points, found without any prediction.

    Where a path is in doubt, they tell pieces of it that have settled in the wrong place
    (`backend.restarts`) and count in what follows (`backend.points`), for which most of them must
    be right to a fifth of a pixel: leave out what lies on a line.
    """

    def matched_points(self, a: Any, b: Any, gate_a: Array, gate_b: Array) -> Array:
        """Points of one picture and where they lie in another, outside what gates close.

        Args:
            a, b: payloads.
            gate_a, gate_b: [h,w] in [0,1], what is open of their cells.
        Returns:
            [n,4]: x, y in the picture of `a`, then in that of `b`, pixels of the working size.
        """
        ...


@runtime_checkable
class SetsAside(Protocol):
    """What correspondence may offer besides: to ask how far a picture moved without some cells."""

    def aside(self, payload: Any, cells: Tensor) -> Any:
        """The payload as one whose cells do not tell how far a picture moved.

        It is only given to `motion`, as the reference, and what can move by itself is set aside so.
        `Motion.matched` is then the share of the picture that the other cells of it have, as under
        the user's mask, unless hardly any are left.

        Args:
            payload: what `encode` returned.
            cells: bool [h,w].
        """
        ...


@runtime_checkable
class FindsLines(Protocol):
    """What correspondence may offer besides: straight edges in a picture.

    Where most of them are along three directions at right angles they tell how the camera is turned
    (`lines.weight`), for which an end should be right to a fifth of a pixel.
    """

    def line_segments(self, payload: Any) -> Array:
        """[n,4]: ends x, y, x, y of straight edges, pixels of the working size."""
        ...
