"""The bundle adjustment problem as data: what a backend gets and what it returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

if TYPE_CHECKING:
    import numpy.typing as npt
    from torch import Tensor

__all__ = ["BAProblem", "PoseTerm", "Report", "Step"]


@dataclass(frozen=True)
class PoseTerm:
    """What is known of the poses besides matches: the energy `x^T H x - 2 g^T x` of their step x.

    x holds the tangent vectors (translation first) of all poses at the start of the step, and H is
    a band: poses further apart in the sequence than its width do not meet.

    Attributes:
        band: [N,B+1,6,6] float64; block [k,m] is H at (k, k - m), row k and the column m before it.
            Blocks [k,0] are symmetric; those with m > k are not read.
        rhs: [N,6] float64, g.
    """

    band: Tensor
    rhs: Tensor

    def check(self, frames: int) -> None:
        """That it is one of so many poses.

        Raises:
            ValueError: band or right side have another shape.
        """
        shapes = {"band": (frames, *self.band.shape[1:2], 6, 6), "rhs": (frames, 6)}
        for name, shape in shapes.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"BAProblem.pose_term.{name} has the shape {found}, not {shape}")

    def to(self, device: torch.device) -> PoseTerm:
        """The same on a device, in float64."""
        return PoseTerm(self.band.to(device, torch.float64), self.rhs.to(device, torch.float64))

    def after(self, count: int) -> PoseTerm:
        """The same with so many poses before these of which nothing is known."""
        band = self.band.new_zeros(count, *self.band.shape[1:])
        return PoseTerm(
            torch.cat([band, self.band]), torch.cat([self.rhs.new_zeros(count, 6), self.rhs])
        )

    def __add__(self, other: PoseTerm) -> PoseTerm:
        """Both, on the device of this one."""
        other = other.to(self.rhs.device)
        width = max(self.band.shape[1], other.band.shape[1])
        band = self.band.new_zeros(len(self.rhs), width, 6, 6)
        for term in (self, other):
            band[:, : term.band.shape[1]] += term.band
        return PoseTerm(band, self.rhs + other.rhs)

    def energy(self, steps: Tensor) -> Tensor:
        """Of steps [N,6] float64, a scalar; 0 without a step."""
        total = -2.0 * (self.rhs * steps).sum()
        for m in range(min(self.band.shape[1], len(steps))):
            product = torch.einsum(
                "ni,nij,nj->", steps[m:], self.band[m:, m], steps[: len(steps) - m]
            )
            total = total + (1.0 if m == 0 else 2.0) * product
        return total


@dataclass(frozen=True)
class BAProblem:
    """Weighted dense bundle adjustment over E directed edges i -> j (REFERENCE 3).

    Energy: sum over edges and cells of `r^T W r` with the residual r = target - projection and the
    information W = [[xx, xy], [xy, yy]] of `weight`, robust if `huber` says so, plus
    `prior_weight * (disp - prior)^2` where `prior > 0`, plus `damping * step^2` elsewhere, plus
    what `pose_term` says of the step of the poses.

    Attributes:
        T_cw: [N,7] world to camera, translation then unit quaternion xyzw.
        disps: [N,h,w] inverse depth, 1/scene-unit, on the grid.
        intrinsics: [4] fx fy cx cy of the grid.
        ii, jj: [E] int64.
        target: [E,h,w,2] measured position of cell of i in j, cells.
        weight: [E,h,w,2] (xx, yy) or [E,h,w,3] (xx, yy, xy), information of the match in 1/cell^2:
            confidence x uncertainty x validity, all factors in. xx, yy >= 0; |xy| <= sqrt(xx yy)
            up to rounding, so 0 where either is 0. Two channels mean xy = 0.
        fixed: [N] bool, poses that must not move. Poses without an edge do not move either.
        damping: [N,h,w] added to the depth diagonal where there is no prior.
        prior: [N,h,w] inverse depth of a depth prior, 0 where there is none; or None.
        prior_weight: gamma_d of REFERENCE 3.2.
        pose_term: what is known of the poses besides; or None. It does not count as a measurement
            of a pose that has none. A backend without it takes the step of None.
        motion_only: move poses, leave depths.
        lm, ep: diag(S) <- diag(S) * (1 + lm) + ep on the reduced system.
        huber: threshold in cells of a Huber kernel on the residual length s, or None;
            s^2 = r^T W r / (trace(W) / 2), the plain length where all directions weigh the same.
        min_disp, max_disp: bounds of the disparity after the step (max None: unbounded).
        guard: evaluate the energy after the step; shorten the step while it rose, and reject it
            if no shorter one lowers the energy.
        pairs: the same edges (i, j) once more on the host, where the caller has them: a backend
            that needs them there would have to wait for a GPU.
    """

    T_cw: Tensor
    disps: Tensor
    intrinsics: Tensor
    ii: Tensor
    jj: Tensor
    target: Tensor
    weight: Tensor
    fixed: Tensor
    damping: Tensor
    prior: Tensor | None = None
    prior_weight: float = 0.0
    pose_term: PoseTerm | None = None
    motion_only: bool = False
    lm: float = 1e-4
    ep: float = 0.1
    huber: float | None = None
    min_disp: float = 1e-5
    max_disp: float | None = None
    guard: bool = False
    pairs: Sequence[tuple[int, int]] | None = None

    @property
    def channels(self) -> int:
        """Channels that `weight` must have: 3 with the off-diagonal of the information, else 2."""
        return 3 if self.weight.shape[-1] == 3 else 2

    def edges(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """`ii` and `jj` on the host, [E] each."""
        if self.pairs is None:
            return self.ii.cpu().numpy(), self.jj.cpu().numpy()
        both = np.asarray(self.pairs, dtype=np.int64).reshape(-1, 2)
        return both[:, 0], both[:, 1]


@dataclass(frozen=True)
class Report:
    """How a step went.

    Attributes:
        status: "ok"; "rejected" (no step lowered the energy); "singular" (the reduced system
            could not be factorised); "nonfinite" (NaN or inf in the solution); "empty"
            (nothing to move). In all but "ok" the step returns its input unchanged.
        cost_before: energy at the start.
        cost_after: energy after the step, NaN unless `guard`.
        step_norm: largest pose update, tangent norm.
        dropped: measurements left out because target or weight was not finite, or because a weight
            below 0 left nothing finite.
        isolated: free poses without any usable measurement; they were held.
    """

    status: Literal["ok", "rejected", "singular", "nonfinite", "empty"]
    cost_before: float
    cost_after: float = float("nan")
    step_norm: float = 0.0
    dropped: int = 0
    isolated: tuple[int, ...] = ()


@dataclass(frozen=True)
class Step:
    """New poses [N,7] and disparities [N,h,w] (fresh tensors), and the report."""

    T_cw: Tensor
    disps: Tensor
    report: Report
