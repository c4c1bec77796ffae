"""Which way a camera is turned, from the lines it sees of what people have built.

Walls, floors, doors and tiles have edges along three directions at right angles (a Manhattan
world: Coughlan and Yuille, Manhattan World, ICCV 1999). In a picture the edges of one direction
point to one vanishing point, so a single picture tells how the camera is turned against all three.
That is known wherever matches say least: along a bare wall, where the motion of a plane has a twin,
and it does not drift. Directions have no names: a turn by which they change places is no other.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from droidw.geometry.se3 import exp, from_matrix, log, rotation
from droidw.solve.problem import PoseTerm

__all__ = [
    "Axes",
    "LineRays",
    "axes_in_turn",
    "named_like",
    "next_axes",
    "rotation_term",
    "shared_axes",
]

Array = npt.NDArray[np.float64]

# Pixels between the end of a line and where its direction says, at which it counts by half; where
# starts are compared, and in the rounds of a fit from a start that lines made, or from a guess.
_FAR, _COMPARED = 0.2, 0.5
_NEAR = (1.0, 0.5, 0.3, 0.2)
_FROM_AFAR = (4.0, 2.0, *_NEAR)
_ROUNDS = 3
# Radians that one step of a fit turns at most, and below which there is no other.
_STEP, _SETTLED = 0.1, 1e-6
# Focal lengths between a line and its vanishing point within which that hardly says where the line
# goes: it may lie on the line itself.
_CLOSE = 0.25
# Lines, longest first, whose directions make starts; and starts that are fitted.
_STARTS, _FITTED = 14, 3
# Sine of the angle between two lines' planes below which they tell no direction.
_ALIKE = 0.05
# Lines that tell how a camera is turned, at least.
_LEAST = 6
# Angle at which a line agrees with a direction: one in twenty-five does by chance.
_AGREES = np.radians(1.2)
# Radians from one picture to the next by which directions are still followed.
_FOLLOWED = np.radians(20.0)
# Radians from where they are expected, and the share of the length of all lines that has to agree
# with them further away. An open door before a bare wall has most of the lines; it led away by 9
# degrees and more, where what was expected was off by 2 at most.
_EXPECTED, _PLAIN = np.radians(6.0), 0.9
# Radians from what lines say at which a pose is hardly held to it any more; where the path is
# settled so many times what is usual, and that much at least.
_MISLED = np.radians(1.0)
_TIMES, _MISLED_LEAST = 4.0, np.radians(0.25)
_SHARED_ROUNDS = 6
# Pictures of a sequence from each of which the others are tried to be followed; radians from what
# has been followed through a picture below which a start there leads to the same.
_SEEDS, _SAME = 6, np.radians(2.0)


def _changes_of_names() -> Array:
    """The 24 rotations by which three axes change places, [24,3,3]."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return np.stack(found)


_NAMES = _changes_of_names()


@dataclass(frozen=True)
class Axes:
    """Three directions at right angles as one camera sees them.

    Attributes:
        turn: [3,3] rotation from the axes to the camera.
        information: [3,3] of a tangent vector on the left of it, one for a line whose end is a
            fifth of a pixel off.
        share: of the length of all lines, what agrees with one of the directions.
    """

    turn: Array
    information: Array
    share: float


class LineRays:
    """Lines of a picture as rays through their middles and ends.

    Args:
        segments: [n,4] ends x, y, x, y in pixels.
        intrinsics: fx, fy, cx, cy of the picture.
    """

    def __init__(self, segments: npt.ArrayLike, intrinsics: Sequence[float]) -> None:
        ends = np.asarray(segments, np.float64).reshape(-1, 2, 2)
        fx, fy, cx, cy = intrinsics
        flat = (ends - (cx, cy)) / (fx, fy)
        rays = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=2)
        self._focal = float(np.sqrt(fx * fy))
        self._middle = rays.mean(axis=1)
        self._cross = np.cross(rays[:, 1], self._middle)
        self._planes = np.cross(rays[:, 0], rays[:, 1])
        self._planes /= np.maximum(np.linalg.norm(self._planes, axis=1, keepdims=True), 1e-12)
        self.length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)

    def __len__(self) -> int:
        return len(self.length)

    def distances(self, turn: Array) -> Array:
        """Of the ends from lines through the middles to all vanishing points, [...,n,3] pixels.

        Less where a vanishing point is close.

        Args:
            turn: [...,3,3] from axes to camera.
        """
        return self._measured(turn)[0]

    def cost(self, turn: Array) -> Array:
        """Sum of log(1 + s^2) over all lines, s the least distance in half pixels; [...]."""
        return self._cost(turn, _COMPARED)

    def energy(self, turn: Array) -> float:
        """The same with s in fifths of a pixel, the unit of the information of `Axes`."""
        return float(self._cost(turn, _FAR))

    def _cost(self, turn: Array, width: float) -> Array:
        least = np.abs(self.distances(turn)).min(axis=-1)
        return np.asarray(np.log1p((least / width) ** 2).sum(axis=-1))

    def axes(self, turn: Array) -> Axes:
        """What the lines say of a turn."""
        least = np.abs(self.distances(turn)).min(axis=-1)
        agrees = least < _AGREES * self.length / 2
        share = self.length[agrees].sum() / max(self.length.sum(), 1e-9)
        return Axes(turn, self._equations(turn, _FAR)[0], float(share))

    def fitted(self, turn: Array, widths: Sequence[float] = _FROM_AFAR) -> Array:
        """The turn that the lines lead to from this one, by a kernel that narrows.

        Args:
            widths: of the kernel, pixels.
        """
        for width in widths:
            for _ in range(_ROUNDS):
                H, g = self._equations(turn, width)
                step = np.linalg.solve(H + (1e-6 * np.trace(H) + 1e-9) * np.eye(3), g)
                size = float(np.linalg.norm(step))
                turn = cv2.Rodrigues(step * min(1.0, _STEP / max(size, 1e-12)))[0] @ turn
                if size < _SETTLED:
                    break
        return turn

    def candidates(self) -> list[Array]:
        """Turns that explain most of the lines, from no idea of them; fitted, best first.

        Two lines of one direction tell it, and a third one another at right angles.
        """
        longest = np.argsort(-self.length, kind="stable")[:_STARTS]
        planes = self._planes[longest]
        if len(planes) < 3:
            return []
        first, second = np.triu_indices(len(planes), 1)
        one = _known_directions(np.cross(planes[first], planes[second]))[0]
        all_ones = np.repeat(one, len(planes), axis=0)
        two, known = _known_directions(np.cross(all_ones, np.tile(planes, (len(one), 1))))
        one = all_ones[known]
        starts = np.stack([one, two, np.cross(one, two)], axis=-1)
        if not len(starts):
            return []
        order = np.argsort(self.cost(starts), kind="stable")[:_FITTED]
        turns = [self.fitted(starts[k], _NEAR) for k in order]
        return sorted(turns, key=lambda turn: float(self.cost(turn)))

    def _measured(self, turn: Array) -> tuple[Array, Array]:
        """Distances, and by what they are divided: how far the vanishing point is."""
        points = np.swapaxes(turn, -1, -2)
        off = self._cross @ turn
        # the picture of the line through the middle, along its normal
        x, y, z = (points[..., None, :, k] for k in range(3))
        across = self._middle[:, 1:2] * z - y, x - self._middle[:, :1] * z
        far = np.sqrt(across[0] ** 2 + across[1] ** 2 + (_CLOSE * z) ** 2) + 1e-9
        return self._focal * off / far, far

    def _equations(self, turn: Array, width: float) -> tuple[Array, Array]:
        """Normal equations of a tangent vector on the left, each line by its nearest direction."""
        distance, far = self._measured(turn)
        nearest = np.abs(distance).argmin(axis=1)
        at = np.arange(len(nearest))
        r = distance[at, nearest] / width
        # exp(w) moves a direction v by w x v
        J = np.cross(turn.T[nearest], self._cross)
        J *= (self._focal / (width * far[at, nearest]))[:, None]
        kept = 1.0 / (1.0 + r * r)
        return (kept[:, None] * J).T @ J, -(kept * r) @ J


def _known_directions(vectors: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Those of vectors [m,3] that are long enough to have one, and which they are."""
    size = np.linalg.norm(vectors, axis=1)
    known = size > _ALIKE
    return vectors[known] / size[known, None], known


def named_like(turn: Array, other: Array) -> Array:
    """The turn with its axes named so that it is nearest to the other one."""
    named = turn @ _NAMES
    return np.asarray(named[np.einsum("kij,ij->k", named, other).argmax()])


def next_axes(lines: LineRays, near: Sequence[Array]) -> Axes | None:
    """Axes of a picture from what they are expected to be.

    Args:
        near: guesses of the turn; not too far from one of them is where it is looked for, and far
            from all of them only where hardly any line says otherwise.
    Returns:
        None where there are too few lines.
    """
    if len(lines) < _LEAST or not near:
        return None
    turns = _turns_about(lines, lines.candidates(), near)
    found = _best(lines, turns)
    if found.share >= _PLAIN:
        return found
    about = [turn for turn in turns if min(_angle(turn, guess) for guess in near) <= _EXPECTED]
    return _best(lines, [*about, *near])


def _followed(lines: LineRays, candidates: Sequence[Array], near: Array) -> Axes:
    return _best(lines, _turns_about(lines, candidates, [near]))


def _turns_about(
    lines: LineRays, candidates: Sequence[Array], near: Sequence[Array]
) -> list[Array]:
    """Turns that lines lead to, not too far from guesses; and these, where they lead away."""
    turns: list[Array] = []
    for guess in near:
        fitted = lines.fitted(guess), lines.fitted(guess, _NEAR)
        tried = [*fitted, *(named_like(turn, guess) for turn in candidates)]
        turns.extend(turn for turn in tried if _angle(turn, guess) < _FOLLOWED)
    return turns or list(near)


def _best(lines: LineRays, turns: Sequence[Array]) -> Axes:
    return lines.axes(min(turns, key=lambda turn: float(lines.cost(turn))))


def _angle(one: Array, other: Array) -> float:
    return float(np.arccos(np.clip((np.sum(one * other) - 1.0) / 2.0, -1.0, 1.0)))


def axes_in_turn(pictures: Sequence[LineRays]) -> list[Axes | None]:
    """Axes of pictures in the order of time, with the same names in all.

    One picture alone may take what moves, or a slanted door, for the axes. So all are followed from
    each of several starts, and the start that explains most of all lines is right.

    Returns:
        None for pictures with too few lines.
    """
    usable = [k for k, lines in enumerate(pictures) if len(lines) >= _LEAST]
    found: list[Axes | None] = [None] * len(pictures)
    if not usable:
        return found
    candidates = {k: pictures[k].candidates() for k in usable}
    chains: list[dict[int, Axes]] = []
    for at in range(0, len(usable), max(1, len(usable) // _SEEDS)):
        seed = usable[at]
        for start in candidates[seed]:
            if any(_angle(named_like(start, c[seed].turn), c[seed].turn) < _SAME for c in chains):
                continue
            chain = {seed: pictures[seed].axes(start)}
            for way in (usable[at + 1 :], usable[:at][::-1]):
                near = start
                for k in way:
                    chain[k] = _followed(pictures[k], candidates[k], near)
                    near = chain[k].turn
            chains.append(chain)
    if not chains:
        return found
    best = min(chains, key=lambda chain: _cost(pictures, chain))
    return [best.get(k) for k in range(len(pictures))]


def _cost(pictures: Sequence[LineRays], chain: dict[int, Axes]) -> float:
    return sum(float(pictures[k].cost(axes.turn)) for k, axes in chain.items())


def shared_axes(T_cw: Tensor, turns: Tensor, information: Tensor) -> Tensor:
    """Rotation [3,3] float64 from the axes to the world, as most cameras see it.

    The axes of one picture are off by a tenth of a degree or three, and all would be turned by that
    against the one they go by. Found from what the first camera says, by those that agree with it
    to a degree or so: a path that is bent by more is measured from its beginning, which is held.

    Args:
        T_cw: [N,7] poses, world to camera, N >= 1.
        turns, information: [N,3,3] of `Axes`.
    """
    R = rotation(T_cw.double())
    turns, H = turns.to(R), R.mT @ information.to(R) @ R
    upright = R[0].mT @ turns[0]
    for _ in range(_SHARED_ROUNDS if len(R) > 1 else 0):
        off = _rotation_vector(R.mT @ turns @ upright.mT)
        weighed = _kept(off, _MISLED).square()[:, None, None] * H
        inverse = torch.linalg.pinv(weighed.sum(0), hermitian=True)
        step = inverse @ (weighed @ off[..., None]).sum(dim=(0, 2))
        upright = rotation(exp(torch.nn.functional.pad(step, (3, 0)))) @ upright
    return upright


def rotation_term(
    T_cw: Tensor,
    turns: Tensor,
    information: Tensor,
    upright: Tensor,
    weight: float,
    settled: bool = False,
) -> PoseTerm:
    """The energy `weight * w^T H w` of how far each camera is turned from what its lines say.

    w is the rotation vector from the one to the other. Linearised, and by a Cauchy kernel: one
    picture in many takes other lines for the axes, and matches know better by then. It is as sure
    of them as others are of theirs, so that even the little that this kernel leaves drags its pose.
    Once the others are where their lines say, the kernel of Geman and McClure leaves nothing.

    Args:
        T_cw: [N,7] poses, world to camera.
        turns, information: [N,3,3] of `Axes`; H is 0 where they are not known.
        upright: [3,3] rotation from the axes to the world.
        weight: in the units of the energy of `BAProblem`, per unit of information.
        settled: the path is hardly bent any more; the kernel is four times what is usual wide.
    """
    R = rotation(T_cw.double())
    off = _rotation_vector(turns.to(R) @ upright.to(R).mT @ R.mT)
    if settled:
        angle = off.norm(dim=1)[information.flatten(1).any(dim=1)]
        usual = float(angle.median()) if len(angle) else 0.0
        kept = _kept(off, min(max(_TIMES * usual, _MISLED_LEAST), _MISLED)).square()
    else:
        kept = _kept(off, _MISLED)
    H = weight * kept[:, None, None] * information.to(R)
    band = torch.zeros(len(R), 1, 6, 6, dtype=R.dtype, device=R.device)
    rhs = torch.zeros(len(R), 6, dtype=R.dtype, device=R.device)
    band[:, 0, 3:, 3:] = H
    rhs[:, 3:] = (H @ off[..., None])[..., 0]
    return PoseTerm(band, rhs)


def _kept(off: Tensor, width: float) -> Tensor:
    """Share [N] that a Cauchy kernel leaves of rotation vectors [N,3].

    Its square is what the kernel of Geman and McClure leaves.
    """
    return (1.0 + (off / width).square().sum(dim=1)).reciprocal()


def _rotation_vector(R: Tensor) -> Tensor:
    """Of rotations [N,3,3], [N,3]."""
    return log(from_matrix(torch.nn.functional.pad(R, (0, 1))))[:, 3:]
