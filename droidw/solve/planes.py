"""Walls and floors that are flat, wherever they are seen.

What people have built is bounded by planes, square to the three directions along which it has its
lines. A floor seen here and a floor seen there is one floor, though no picture holds both: a path
that has drifted in scale in between finds it at two heights. So a cell near a plane is held to it,
as a match is to where it was found.

To bundle adjustment a plane is one keyframe more, which does not move: a camera that lies in the
plane, far away, and looks along it. What is in the plane it sees on its middle row. A match there
that counts across that row alone says how far off the plane a cell is, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from droidw.geometry.projective import viewing_rays
from droidw.geometry.se3 import from_matrix, inv, rotation
from droidw.solve.problem import BAProblem, PoseTerm

__all__ = ["Plane", "find_planes", "held_to_planes"]

# Of the depth of a cell: how far off a plane it counts by a quarter; depths below this share of
# the median have the width of that.
_WIDTH, _LEAST_DEPTH = 0.01, 0.3
# Depths, in medians, beyond which a cell tells no plane.
_FAR = 3.0
# Share of all cells that are near one plane, at least; planes of one direction, at most, and how
# many widths they are apart.
_LEAST_SHARE, _MOST, _APART = 0.05, 6, 8.0
# Bins of the width of a plane, and what a cell counts in its own and those beside it.
_BINS, _SPREAD = 2.0, (0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25)
# Rounds of a fit.
_ROUNDS = 5
# A cell without any disparity is far away, and not nowhere.
_LEAST_DISP = 1e-9
# Cells of a keyframe on one plane below which they are left alone.
_LEAST_CELLS = 10
# How far behind all cells the camera of a plane is, in median depths.
_AWAY = 20.0


@dataclass(frozen=True)
class Plane:
    """Points whose coordinate along one axis is the same.

    Attributes:
        axis: 0, 1 or 2. offset: that coordinate, scene units.
        share: of the cells that were looked at, what lies near it.
    """

    axis: int
    offset: float
    share: float

    @property
    def along(self) -> int:
        """An axis that lies in the plane; `across`: the other one, so that the three are a turn."""
        return (self.axis + 1) % 3

    @property
    def across(self) -> int:
        """See `along`."""
        return (self.axis + 2) % 3


@dataclass(frozen=True)
class _Cells:
    """Where all cells are.

    Attributes:
        points: [N,P,3] along the axes. depth: [N,P].
        weight: [N,P], 0 where a cell is too far. median: of the depths of what is open.
    """

    points: Tensor
    depth: Tensor
    weight: Tensor
    median: float

    def width(self) -> Tensor:
        """[N,P], how far off a plane a cell counts by a quarter."""
        return _WIDTH * self.depth.clamp_min(_LEAST_DEPTH * self.median)


def find_planes(
    T_cw: Tensor, disps: Tensor, intrinsics: Tensor, upright: Tensor, open_: Tensor
) -> list[Plane]:
    """Planes square to the axes near which many cells lie, by axis and then by how many.

    Args:
        T_cw: [N,7] world to camera. disps: [N,h,w]. intrinsics: [4] of the grid.
        upright: [3,3] float64 rotation from the axes to the world.
        open_: [N,h,w] in [0,1], what of each cell counts.
    """
    cells = _cells(T_cw, disps, intrinsics, upright, open_)
    return [] if cells is None else _planes(cells)


def held_to_planes(problem: BAProblem, upright: Tensor, open_: Tensor, weight: float) -> BAProblem:
    """The problem with its cells held to the planes that they lie near.

    The energy `weight * (e / width)^2` of each, e its distance from the nearest plane and the width
    a hundredth of its depth; by the square of a Cauchy kernel, and with planes where they lie most
    now, so that they move from step to step.

    Args:
        upright, open_: as of `find_planes`.
        weight: in the units of the energy of `BAProblem`.
    Returns:
        The problem, with a keyframe for each plane behind the others, to be left out afterwards.
    """
    cells = _cells(problem.T_cw, problem.disps, problem.intrinsics, upright, open_)
    planes = [] if cells is None else _planes(cells)
    if cells is None or not planes:
        return problem
    used = cells.points[cells.weight > 0]
    behind = used.amin(0) - _AWAY * cells.median
    off = torch.stack([cells.points[..., plane.axis] - plane.offset for plane in planes])
    nearest, width = off.abs().argmin(0), cells.width()
    cameras, ii, jj, held = [], [], [], []
    for k, plane in enumerate(planes):
        information = _kernel(off[k], width) * cells.weight / width.square()
        information = torch.where(nearest == k, information, 0.0)
        at = ((information > 0).sum(1) >= _LEAST_CELLS).nonzero().flatten()
        place = behind.clone()
        place[plane.axis] = plane.offset
        depth = cells.points[at][..., plane.along] - place[plane.along]
        # what is e off the plane is seen focal * e / depth off the row
        held.append(weight * information[at] * (depth / problem.intrinsics[1]).square())
        cameras.append(_camera(plane, upright, place))
        ii.append(at)
        jj.append(torch.full_like(at, len(problem.T_cw) + k))
    seen = _Seen(torch.stack(cameras), torch.cat(ii), torch.cat(jj), torch.cat(held))
    return _with(problem, seen)


@dataclass(frozen=True)
class _Seen:
    """What the cameras of planes see.

    Attributes:
        T_cw: [K,7] of the cameras. ii, jj: [E] edges from keyframes to them.
        information: [E,P] of the second coordinate of each cell, 1/cell^2.
    """

    T_cw: Tensor
    ii: Tensor
    jj: Tensor
    information: Tensor


def _with(problem: BAProblem, seen: _Seen) -> BAProblem:
    """The problem with these cameras behind the others, held."""
    count, edges, shape = len(seen.T_cw), len(seen.ii), problem.disps.shape[-2:]
    weight = problem.weight.new_zeros(edges, *shape, problem.channels)
    weight[..., 1] = seen.information.view(edges, *shape)
    target = problem.intrinsics[2:].to(problem.target).expand(edges, *shape, 2)
    pairs, term = problem.pairs, problem.pose_term
    if pairs is not None:
        pairs = [*pairs, *zip(seen.ii.tolist(), seen.jj.tolist(), strict=True)]
    if term is not None:
        term = PoseTerm(_padded(term.band, count), _padded(term.rhs, count))
    return replace(
        problem,
        T_cw=torch.cat([problem.T_cw, seen.T_cw.to(problem.T_cw)]),
        disps=_padded(problem.disps, count, 1.0),
        ii=torch.cat([problem.ii, seen.ii]),
        jj=torch.cat([problem.jj, seen.jj]),
        target=torch.cat([problem.target, target]),
        weight=torch.cat([problem.weight, weight]),
        fixed=_padded(problem.fixed, count, True),
        damping=_padded(problem.damping, count, 1.0),
        prior=None if problem.prior is None else _padded(problem.prior, count),
        pose_term=term,
        pairs=pairs,
    )


def _padded(rows: Tensor, count: int, value: float = 0.0) -> Tensor:
    return torch.cat([rows, rows.new_full((count, *rows.shape[1:]), value)])


def _camera(plane: Plane, upright: Tensor, place: Tensor) -> Tensor:
    """[7] of a camera at a place along the axes that looks along the plane."""
    order = [plane.across, plane.axis, plane.along]
    pose = place.new_zeros(3, 4)
    pose[:, :3] = upright.mT[order]
    pose[:, 3] = -place[order]
    return from_matrix(pose)


def _cells(
    T_cw: Tensor, disps: Tensor, intrinsics: Tensor, upright: Tensor, open_: Tensor
) -> _Cells | None:
    """None where nothing is open."""
    h, w = disps.shape[-2:]
    rays = viewing_rays(h, w, intrinsics.double()).view(-1, 3)
    depth = disps.double().flatten(1).clamp_min(_LEAST_DISP).reciprocal()
    weight = open_.double().flatten(1)
    T = T_cw.double()
    points = (rays @ (rotation(T) @ upright)) * depth[..., None]
    points += (inv(T)[:, :3] @ upright)[:, None]
    counts = depth[weight > 0.5]
    if not len(counts):
        return None
    median = float(counts.median())
    return _Cells(points, depth, torch.where(depth < _FAR * median, weight, 0.0), median)


def _planes(cells: _Cells) -> list[Plane]:
    total, width = float(cells.weight.sum()), cells.width()
    found = []
    for axis in range(3):
        at = cells.points[..., axis]
        for start, share in _peaks(at, cells, total):
            offset = start
            for _ in range(_ROUNDS):
                kept = _kernel(at - offset, width) * cells.weight
                offset = float((kept * at).sum() / kept.sum().clamp_min(1e-12))
            found.append(Plane(axis, offset, share))
    return found


def _peaks(at: Tensor, cells: _Cells, total: float) -> list[tuple[float, float]]:
    """Coordinates at which many cells lie and what share of all these are, most first."""
    size = _WIDTH * cells.median / _BINS
    use = cells.weight > 0
    low = float(at[use].min())
    place = ((at[use] - low) / size).long()
    count = torch.zeros(int(place.max()) + 1, dtype=at.dtype, device=at.device)
    count.index_add_(0, place, cells.weight[use])
    spread = count.new_tensor(_SPREAD)
    near = torch.nn.functional.conv1d(count[None, None], spread[None, None], padding="same")[0, 0]
    left, apart, found = near.cpu(), round(_APART * _BINS), []
    for _ in range(_MOST):
        top = int(left.argmax())
        share = float(left[top]) / total
        if share < _LEAST_SHARE:
            break
        found.append((low + (top + 0.5) * size, share))
        left[max(0, top - apart) : top + apart + 1] = 0.0
    return found


def _kernel(off: Tensor, width: Tensor) -> Tensor:
    return (1.0 + (off / width).square()).square().reciprocal()
