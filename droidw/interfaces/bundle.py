"""Bundle adjustment backends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from droidw.solve.problem import BAProblem, Step

__all__ = ["BundleAdjuster"]


@runtime_checkable
class BundleAdjuster(Protocol):
    """Dense bundle adjustment; sees weights, never features or uncertainty."""

    def step(self, problem: BAProblem) -> Step:
        """One damped Gauss-Newton step with per-cell depth elimination (REFERENCE 3.2, 3.3).

        Never returns a value that is not finite: what cannot be solved is said in the report.
        """
        ...
