"""Conformance of correspondence operators."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from droidw.errors import InputError
from droidw.geometry.camera import Grid
from droidw.interfaces.correspondence import (
    Correspondence,
    EdgeRequest,
    EdgeSession,
    EdgeUpdate,
    FindsLines,
    MatchesPoints,
    Motion,
    SetsAside,
)
from droidw.slam.frame import Frame
from droidw.testing._contract import Subject, same, snapshot
from droidw.testing.scenes import Scene, SceneSpec

__all__ = ["correspondence"]

_INDICES = (0, 3, 6)
_EDGES = ((0, 1), (1, 0), (1, 2), (2, 1))
# Rows and columns of the picture that are kept: all, and a part of odd size.
_CROPS = ((240, 320), (203, 277))


def correspondence(subject: Subject) -> None:
    """See `droidw.testing.conformance.check_correspondence`."""
    part = subject.build(seed=3)
    subject.follows(part, Correspondence)
    subject.expect(
        "grid",
        isinstance(part.stride, int) and part.stride >= 1 and 0 <= part.offset < part.stride,
        f"stride {part.stride!r} and offset {part.offset!r} make no grid",
    )
    scene = Scene(SceneSpec())
    pictures = [scene.render(k) for k in _INDICES]
    for rows, columns in _CROPS:
        part = subject.build(seed=3)  # an operator serves one run, whose pictures have one size
        frames = []
        for picture in pictures:
            image = torch.from_numpy(picture.image[:rows, :columns].copy())
            frames.append(
                Frame(
                    picture.index,
                    picture.time,
                    image.permute(2, 0, 1).float().div(255).contiguous().to(subject.device),
                    torch.from_numpy(scene.intrinsics).float().to(subject.device),
                    f"{picture.index:06d}",
                )
            )
        grid = Grid.of(rows, columns, part.stride, part.offset)
        label = f"pictures of {columns}x{rows}"
        if (rows, columns) != _CROPS[0] and _refuses(part, frames[0], grid):
            continue
        payloads = _encode(subject, part, frames, grid)
        update = _sessions(subject, part, payloads, grid, label)
        _accuracy(subject, scene, update, grid, label)
        twin = subject.build(seed=3)
        other = twin.session().update(
            _request(subject, _encode(subject, twin, frames, grid), grid, list(range(4)), _EDGES)
        )
        subject.expect(
            "deterministic",
            same(update.target, other.target) and same(update.confidence, other.confidence),
            f"two operators of one seed answer differently for {label}",
        )
        _motion(subject, part, payloads)
        _aside(subject, part, payloads, grid)
        _points(subject, part, payloads, grid, (rows, columns))
        _lines(subject, part, payloads, (rows, columns))


def _refuses(part: Any, frame: Frame, grid: Grid) -> bool:
    """Whether pictures of this size are refused in a sentence, as a network may do."""
    try:
        part.encode(frame, grid)
    except InputError:
        return True
    return False


def _encode(subject: Subject, part: Any, frames: list[Frame], grid: Grid) -> list[Any]:
    payloads = []
    for frame in frames:
        before = snapshot(frame)
        with subject.calling("encode and context"):
            payloads.append(part.context(part.encode(frame, grid), frame, grid))
        subject.unchanged("the frame given to encode and context", before, frame)
    return payloads


def _request(
    subject: Subject,
    payloads: list[Any],
    grid: Grid,
    ids: list[int],
    edges: tuple[tuple[int, int], ...],
) -> EdgeRequest:
    """A question without any knowledge of poses: every cell is expected where it was."""
    h, w = grid.height, grid.width
    y, x = torch.meshgrid(torch.arange(float(h)), torch.arange(float(w)), indexing="ij")
    coords = torch.stack([x, y], dim=-1).expand(len(edges), h, w, 2).contiguous()
    valid = torch.ones(len(edges), h, w, dtype=torch.bool)
    return EdgeRequest(
        ids,
        [i for i, _ in edges],
        [j for _, j in edges],
        coords.to(subject.device),
        valid.to(subject.device),
        payloads.__getitem__,
        informed=False,
    )


def _ask(subject: Subject, session: EdgeSession, request: EdgeRequest, label: str) -> EdgeUpdate:
    coords, ids = snapshot(request.coords), list(request.ids)
    with subject.calling(f"update on {label}"):
        update = session.update(request)
    subject.unchanged("the request's coords", coords, request.coords)
    subject.expect("no-mutation", ids == request.ids, "the request's ids were changed")
    subject.expect(
        "shape",
        isinstance(update, EdgeUpdate),
        f"update returned a {type(update).__name__}, not an EdgeUpdate",
    )
    shape = tuple(request.coords.shape)
    subject.tensor(f"the target for {label}", update.target, shape)
    channels = 3 if update.confidence.shape[-1:] == (3,) else 2
    subject.tensor(f"the confidence for {label}", update.confidence, (*shape[:3], channels))
    subject.expect(
        "range",
        bool((update.confidence[..., :2] >= 0).all()),
        f"a confidence is negative for {label}",
    )
    if channels == 3:
        xx, yy, xy = update.confidence.double().unbind(-1)
        subject.expect(
            "range",
            bool((xy.square() <= xx * yy + 1e-5 * (xx + yy).square()).all()),
            f"the off-diagonal of a confidence is beyond sqrt(xx yy) for {label}",
        )
    if update.damping is not None or update.upmask is not None:
        sources = sorted(set(request.ii))
        subject.expect(
            "sources",
            update.sources == sources,
            f"sources is {update.sources}, but the source frames are {sources}",
        )
    for name in ("damping", "upmask"):
        value = getattr(update, name)
        if value is not None:
            middle = (576,) if name == "upmask" else ()
            subject.tensor(name, value, (len(set(request.ii)), *middle, *shape[1:3]))
    return update


def _sessions(
    subject: Subject, part: Any, payloads: list[Any], grid: Grid, label: str
) -> EdgeUpdate:
    for purpose in ("global", "fill"):
        with subject.calling(f"session('{purpose}')"):
            session = part.session(purpose)
        _ask(
            subject,
            session,
            _request(subject, payloads, grid, [5], ((1, 0),)),
            f"{label} ({purpose})",
        )
    with subject.calling("session()"):
        session = part.session()
    subject.follows(session, EdgeSession)
    _ask(subject, session, _request(subject, payloads, grid, [], ()), f"no edges at all, {label}")
    first = _ask(subject, session, _request(subject, payloads, grid, [3, 8, 1, 20], _EDGES), label)
    turned = _ask(
        subject,
        part.session(),
        _request(subject, payloads, grid, [20, 1, 8, 3], _EDGES[::-1]),
        label,
    )
    subject.expect(
        "order",
        bool(torch.allclose(turned.target.flip(0), first.target, atol=1e-3)),
        "the answers do not come in the order of the request",
    )
    _ask(
        subject,
        session,
        _request(subject, payloads, grid, [8, 21], ((1, 0), (0, 2))),
        f"a known and a new edge, {label}",
    )
    with subject.calling("forget, with an unknown id among them,"):
        session.forget([3, 1, 12345])
    # A forgotten id is new: it must get the answer of its new edge.
    reused = _ask(
        subject,
        session,
        _request(subject, payloads, grid, [3], ((1, 2),)),
        f"an id used again after forget, {label}",
    )
    subject.expect(
        "forget",
        bool(torch.allclose(reused.target[0], first.target[2], atol=1e-3)),
        "an id that was forgotten and used for another edge gets a stale answer",
    )
    return first


def _accuracy(subject: Subject, scene: Scene, update: EdgeUpdate, grid: Grid, label: str) -> None:
    cells = grid.centres().double().numpy()
    for number, (i, j) in enumerate(_EDGES):
        truth = scene.correspond(_INDICES[i], _INDICES[j], cells)
        target = update.target[number].cpu().double().numpy() * grid.stride + grid.offset
        confidence = update.confidence[number, ..., :2].amax(dim=-1).cpu().numpy()
        sure = confidence > 0.5 * confidence.max() if confidence.max() > 0 else confidence > 0
        subject.expect(
            "accuracy",
            bool(sure.mean() > 0.1),
            f"hardly any cell of {label} has confidence, though 9 in 10 are visible",
        )
        error = np.linalg.norm(target - truth.target, axis=-1)[sure & truth.visible]
        median = float(np.median(error)) if len(error) else float("inf")
        subject.expect(
            "accuracy",
            median < 2.0,
            f"the median error of confident cells is {median:.2f} pixels for {label}, "
            f"edge {i} -> {j}; 2 pixels at most are due",
        )


def _motion(subject: Subject, part: Any, payloads: list[Any]) -> None:
    with subject.calling("motion"):
        still, near, far = (part.motion(payloads[0], payloads[k]) for k in (0, 1, 2))
    for motion in (still, near, far):
        subject.expect(
            "motion",
            isinstance(motion, Motion)
            and np.isfinite(motion.flow)
            and motion.flow >= 0
            and 0 <= motion.matched <= 1,
            f"motion returned {motion!r}",
        )
    subject.expect(
        "motion", still.flow < 0.1, f"a frame has moved by {still.flow:.2f} cells against itself"
    )
    subject.expect(
        "motion",
        still.flow <= near.flow < far.flow,
        f"motion does not grow with the distance of frames: {near.flow:.2f} cells after "
        f"3 frames, {far.flow:.2f} after 6",
    )


def _aside(subject: Subject, part: Any, payloads: list[Any], grid: Grid) -> None:
    """Cells that are not to tell how far a picture moved, where the part can set them aside."""
    motion = part.motion
    if not isinstance(part, SetsAside):
        return
    cells = torch.zeros(grid.height, grid.width, dtype=torch.bool, device=subject.device)
    with subject.calling("aside"):
        same_as_ever = motion(part.aside(payloads[0], cells), payloads[1])
        cells[:, : grid.width // 2] = True
        half = motion(part.aside(payloads[0], cells), payloads[1])
    whole = motion(payloads[0], payloads[1])
    subject.expect(
        "aside",
        same_as_ever == whole,
        f"with no cell set aside motion is {same_as_ever!r}, and {whole!r} without asking",
    )
    subject.expect(
        "aside",
        0 <= half.matched < whole.matched and np.isfinite(half.flow),
        f"with half of the cells set aside motion is {half!r}, and {whole!r} with all",
    )


def _points(
    subject: Subject, part: Any, payloads: list[Any], grid: Grid, size: tuple[int, int]
) -> None:
    """Points matched without a prediction, where the part has them."""
    if not isinstance(part, MatchesPoints):
        return
    gate = np.ones((grid.height, grid.width), np.float32)
    with subject.calling("matched_points"):
        seen = np.asarray(part.matched_points(payloads[0], payloads[1], gate, gate))
        unseen = np.asarray(part.matched_points(payloads[0], payloads[1], gate, 0 * gate))
    subject.expect(
        "matched_points",
        _in_pictures(seen, size),
        f"points of pictures of {size[1]}x{size[0]} are {seen!r}; due are rows of x, y here and "
        "x, y there, in pixels of these pictures",
    )
    subject.expect(
        "matched_points",
        unseen.shape == (0, 4),
        f"{len(unseen)} points are matched in a picture whose cells are all closed",
    )


def _in_pictures(rows: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether rows are two places x, y each, in pictures of this height and width."""
    if rows.ndim != 2 or rows.shape[1] != 4:
        return False
    within = np.array([size[1], size[0], size[1], size[0]])
    return bool(((rows > -1) & (rows < within)).all())


def _lines(subject: Subject, part: Any, payloads: list[Any], size: tuple[int, int]) -> None:
    """Straight edges of a picture, where the part finds them."""
    if not isinstance(part, FindsLines):
        return
    with subject.calling("line_segments"):
        found, again = (np.asarray(part.line_segments(payloads[0])) for _ in range(2))
    subject.expect(
        "line_segments",
        _in_pictures(found, size),
        f"lines in a picture of {size[1]}x{size[0]} are {found!r}; due are rows of x, y of one end "
        "and x, y of the other, in pixels of the picture",
    )
    subject.expect(
        "line_segments",
        np.array_equal(found, again),
        "lines of one picture differ when asked again",
    )
