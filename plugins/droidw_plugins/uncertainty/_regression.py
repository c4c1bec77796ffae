"""Ridge regression that more can be added to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Regression"]

# Share of the mean square of a feature that is added to all.
_RIDGE = 0.1


@dataclass(frozen=True)
class Regression:
    """Sums over all rows [f, 1] so far, of C features and a constant.

    Attributes:
        square: [C+1,C+1] of their outer products. right: [C+1] of y [f, 1]. count: how many, [].
    """

    square: Tensor
    right: Tensor
    count: Tensor

    @staticmethod
    def of(rows: Tensor, y: Tensor) -> Regression:
        """Of rows [n,P,C] and what they are to give, [n,P]."""
        ones = rows.new_ones(rows.shape[0] * rows.shape[1], 1)
        design = torch.cat([rows.flatten(0, 1), ones], dim=1)
        return Regression(
            design.T @ design, design.T @ y.flatten(), ones.new_tensor(float(len(ones)))
        )

    def and_then(self, later: Regression, keep: float) -> Regression:
        """The later one, and a share `keep` of this one."""
        return Regression(
            keep * self.square + later.square,
            keep * self.right + later.right,
            keep * self.count + later.count,
        )

    def theta(self) -> Tensor:
        """[C+1], weights and constant whose map of the rows comes closest to y."""
        square = self.square / self.count
        square.diagonal().add_(_RIDGE * square.diagonal().mean())
        theta: Tensor = torch.linalg.solve(square, self.right / self.count)
        return theta

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of the sums, for `Regression(**state)`."""
        return {name: getattr(self, name).clone() for name in ("square", "right", "count")}
