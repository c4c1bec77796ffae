"""Refines the focal length during global adjustment.

A focal length from a data sheet or of another camera of the same make is often wrong by a few
per cent, which bends the whole path; one that was guessed is wrong by far more. The energy that
bundle adjustment leaves tells: it is least at the true one, if the camera turns and moves enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from droidw.config.schema import CameraConfig, PhaseConfig, SolverConfig
    from droidw.graph.factors import FactorGraph
    from droidw.slam.optimise import Optimiser

__all__ = ["MIN_KEYFRAMES", "FocalSearch", "minimise_with_prior", "refine_focal"]

MIN_KEYFRAMES = 12
"""Fewer keyframes than this say too little about a focal length."""

# First step either way, and the longest one, of the logarithm of the focal length.
_FIRST_STEP = 0.03
_LONGEST_STEP = 0.1
# Smaller changes than this are not worth another evaluation.
_SETTLED = 0.003
# Gauss-Newton steps after which the energy at a new focal length has settled to 0.1 per cent.
_STEPS = 4
_MOST_EVALUATIONS = 8
# A guess has this share of the trust of a calibration.
_GUESSED = 0.1


@dataclass(frozen=True)
class FocalSearch:
    """What a search found.

    Attributes:
        factor: of the focal length; 1 where nothing better was found.
        tried: (factor, energy left by bundle adjustment) in the order of trial.
    """

    factor: float
    tried: tuple[tuple[float, float], ...]


def minimise_with_prior(
    energy: Callable[[float], float], trust: float, bound: float
) -> tuple[float, list[tuple[float, float]]]:
    """The x in [-bound, bound] where `energy(x) + trust/2 * x^2 * energy(0)` is least.

    Parabolas through the three best points so far; `energy` need not be exact, but smooth.

    Args:
        energy: positive, of x = log of the factor; called at most eight times.
        trust: curvature of the prior, relative to the energy at 0.
        bound: largest |x|.
    Returns:
        x, 0 if no other was better; and all (x, energy with prior).
    """
    seen: dict[float, float] = {}

    def look(x: float) -> float:
        if x not in seen:
            found = energy(x)
            at_zero = seen.get(0.0, found)
            seen[x] = found + 0.5 * trust * x * x * at_zero
        return seen[x]

    look(0.0)
    step = min(_FIRST_STEP, bound)
    look(step)
    look(-step)
    while len(seen) < _MOST_EVALUATIONS and all(math.isfinite(value) for value in seen.values()):
        best = sorted(seen, key=lambda x: seen[x])[:3]
        aim = _vertex([(x, seen[x]) for x in best])
        if aim is None:  # no valley: on downhill, away from the worst of the three
            aim = best[0] + math.copysign(_LONGEST_STEP, best[0] - best[2])
        aim = min(max(aim, best[0] - _LONGEST_STEP), best[0] + _LONGEST_STEP)
        aim = min(max(aim, -bound), bound)
        if min(abs(aim - x) for x in seen) < _SETTLED:
            break
        look(aim)
    known = {x: value for x, value in seen.items() if math.isfinite(value)}
    return min(known, key=lambda x: known[x], default=0.0), list(seen.items())


def refine_focal(
    optimiser: Optimiser,
    graph: FactorGraph,
    phase: PhaseConfig,
    solver: SolverConfig,
    camera: CameraConfig,
    known: bool,
) -> FocalSearch:
    """Find the focal length of least energy, and leave store and camera there.

    Poses and depths are adjusted at every focal length tried, with the measurements that the
    graph holds. The energy counts the prior of `camera.focal_trust` (a tenth of it for a guess),
    and how far lines are from three directions at right angles, where these count: that tells a
    focal length to some tenths of a per cent. Matches have their own bias, so that a calibration
    stays as it is where what is found differs by less than `camera.focal_slack`, and where the
    energy by itself is no valley as steep as the prior: it says little then but its bias.

    Args:
        known: the focal length is a calibration, not a guess.
    """
    store = optimiser.store
    given = store.intrinsics.clone(), store.image_intrinsics.clone()
    start = store.T_cw.clone(), store.disps.clone()
    rows = graph.select()
    steps = replace(phase, iterations=_STEPS, learn=False)
    # Weights that change with the residuals would make each energy a sum of other weights. Without
    # them wrong matches pull, so depths that say little stay.
    solver = replace(solver, cauchy=0.0, depth_damping=1.0)

    def place(x: float) -> None:
        factor = math.exp(x)
        for intrinsics, before in zip(
            (store.intrinsics, store.image_intrinsics), given, strict=True
        ):
            intrinsics[:2] = before[:2] * factor

    states = {}
    usual: list[float] = []

    def energy(x: float) -> float:
        place(x)
        store.write(*start)
        # Axes by another focal length would hold on to it.
        lines = optimiser.upright.refit()
        optimiser.adjust(graph, rows, steps, solver, first_free=1)
        states[x] = store.T_cw.clone(), store.disps.clone()
        usual.append(optimiser.usual)
        return optimiser.cost + lines * usual[0]

    trust, bound = camera.focal_trust, camera.focal_range
    x, tried = minimise_with_prior(energy, trust if known else _GUESSED * trust, bound)
    if known and (abs(x) < camera.focal_slack or not _tells(tried, trust)):
        x = 0.0
    place(x)
    optimiser.upright.measure()
    store.write(*states[x])
    return FocalSearch(math.exp(x), tuple((math.exp(k), value) for k, value in tried))


def _tells(tried: list[tuple[float, float]], trust: float) -> bool:
    """Whether measurements hold a focal length at least as hard as its prior does.

    Args:
        tried: (x, energy with prior) of `minimise_with_prior`; the first three are 0 and one step
            to either side.
    """
    (_, at_zero), (step, right), (_, left) = tried[:3]
    return right + left - 2 * at_zero >= 2 * trust * step * step * at_zero


def _vertex(points: list[tuple[float, float]]) -> float | None:
    """Lowest point of the parabola through three points; None if it opens downwards."""
    (a, fa), (b, fb), (c, fc) = points
    slope_ab, slope_ac = (fb - fa) / (b - a), (fc - fa) / (c - a)
    curvature = (slope_ac - slope_ab) / (c - b)
    if not curvature > 0:
        return None
    return 0.5 * (a + b - slope_ab / curvature)
