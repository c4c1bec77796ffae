"""All keyframes tracked once more, from the last one to the first.

Matches are searched around what poses predict, so a path that went astray explains what it
measured itself; it takes another path to see that. What is hard in one direction of time, a
camera that sets off fast or a first look at a bare wall, often is not in the other.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from droidw.events import Dispatcher, Progress
from droidw.geometry.se3 import inv, mul
from droidw.graph.store import KeyframeStore
from droidw.slam.backend import Backend
from droidw.slam.doubt import doubtful
from droidw.slam.frontend import Frontend
from droidw.slam.optimise import Optimiser

if TYPE_CHECKING:
    from droidw.config.schema import DroidwConfig
    from droidw.slam.diagnosis import Diagnosis

__all__ = ["WayBack", "doubted", "track_backwards"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WayBack:
    """The keyframes of a run, last first, tracked in that order.

    Attributes:
        store: poses and depths are new, the rest is that of the run.
        agreement: as of `Backend`.
    """

    store: KeyframeStore
    agreement: float

    def write_to(self, store: KeyframeStore) -> None:
        """Let the run have these poses and depths; its first pose stays what it was."""
        T_cw, first = self.store.T_cw.flip(0), store.T_cw[:1].clone()
        store.write(mul(mul(T_cw, inv(T_cw[:1])), first), self.store.disps.flip(0))
        store["damping"].copy_(self.store["damping"].flip(0))
        for info, other in zip(store.infos, reversed(self.store.infos), strict=True):
            info.disp_full = other.disp_full


def doubted(
    optimiser: Optimiser,
    config: DroidwConfig,
    found: Diagnosis,
    events: Dispatcher,
    stopped: Callable[[], bool],
) -> Diagnosis:
    """Where too little of what a run measured agrees, let it have what the way back finds.

    That is kept only if more of what it measures agrees. What was found stays if it fails, too.

    Args:
        optimiser: of the run; poses and depths of its store may change.
        found: of the run so far.
        stopped: whether the run is to end soon.
    Returns:
        What to say of what is kept.
    """
    agreement = found.agreement
    if not doubtful(agreement, config.backend.backwards_below):
        return found
    _log.info(
        "%.0f %% of what was measured agrees with poses and depths: tracking the keyframes "
        "backwards (backend.backwards_below=0 does not)",
        100 * agreement,
    )

    def tell(done: int, total: int) -> None:
        events.emit(Progress("backwards", done, total))

    try:
        with optimiser.clock("backwards"):
            back = track_backwards(optimiser, config, tell, stopped)
    except Exception as error:  # noqa: BLE001 - what was found forwards is as good as it was
        why = str(error) or type(error).__name__
        events.warn(f"the keyframes could not be tracked backwards, what was found is kept: {why}")
        return found
    if back is None:
        return found
    kept = back.agreement > agreement
    _log.info("%.0f %% agrees backwards%s", 100 * back.agreement, ", kept" if kept else "")
    if kept:
        back.write_to(optimiser.store)
        found = replace(found, agreement=back.agreement, backwards=True)
    return found


def track_backwards(
    optimiser: Optimiser,
    config: DroidwConfig,
    tell: Callable[[int, int], None],
    stopped: Callable[[], bool],
) -> WayBack | None:
    """Track the keyframes of a run from the last one to the first, and adjust them globally.

    It sets off from the last poses and depths of the run. No keyframe is dropped. Uncertainty stays
    as it has learned to be, so that what agrees there and back is weighed alike.

    Args:
        optimiser: of the run, whose store is left as it is.
        tell: called with (keyframes and update steps done, those in all).
        stopped: asked before each of these; whether to give up.
    Returns:
        None if there is nothing to track, or it was given up.
    """
    known = optimiser.store
    count, first = len(known), config.frontend.warmup
    if count <= first:
        return None
    schedule = {name: replace(row, learn=False) for name, row in config.schedule.items()}
    camera = replace(config.camera, refine_focal=False)
    config = replace(config, schedule=schedule, camera=camera)
    store = known.blank()
    frontend = Frontend(optimiser.beside(store), config)
    steps = sum(config.backend.passes)

    def told(done: int) -> None:
        if stopped():
            raise _Stopped
        tell(done, count + steps)

    try:
        for done, node in enumerate(reversed(range(count))):
            told(done)
            # Time runs on for those that guess by it.
            info = replace(known.infos[node], time=-known.infos[node].time, disp_full=None)
            values = known.values(node)
            if done >= first:
                values["T_cw"], values["disps"] = frontend.guess(info.time)
            store.append(info, **values)
            if done == first - 1:
                frontend.resume()
            elif done >= first:
                frontend.grow(forced=True)
        frontend.release()
        backend = Backend(frontend.optimiser, config)
        backend.run(lambda done, total: told(count + done))
    except _Stopped:
        return None
    optimiser.add_reports(frontend.optimiser)
    return WayBack(store, backend.agreement)


class _Stopped(Exception):
    """The run is to end."""
