"""One step of bundle adjustment, and what is done where it cannot be made."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from droidw.slam.contract import step_of

if TYPE_CHECKING:
    from droidw.interfaces.bundle import BundleAdjuster
    from droidw.solve.problem import BAProblem, Step

__all__ = ["stepped"]

# Levenberg damping of poses, as a share of their information and as such, by which a system that
# could not be factorised is solved once more (those of DROID-SLAM).
_FIRM_LM, _FIRM_EP = 1e-4, 0.1


def stepped(ba: BundleAdjuster, problem: BAProblem) -> Step:
    """The step that a backend makes; with more damping where its system is singular without.

    Cells that say next to nothing of a pose leave it with less than rounding does, and all others
    of the same system would stay where they are for it.

    Raises:
        PluginError: as `step_of`.
    """
    step = step_of(ba.step(problem), problem)
    if step.report.status != "singular" or (problem.lm >= _FIRM_LM and problem.ep >= _FIRM_EP):
        return step
    firm = replace(problem, lm=max(problem.lm, _FIRM_LM), ep=max(problem.ep, _FIRM_EP))
    return step_of(ba.step(firm), firm)
