"""All keyframes tracked once more, from the last one to the first.

Matches are searched around what poses predict, so a path that went astray explains what it
measured itself; it takes another path to see that. What is hard in one direction of time, a
camera that sets off fast or a first look at a bare wall, often is not in the other.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import torch

from droidw.events import Dispatcher, Progress
from droidw.slam.backend import Backend
from droidw.slam.frontend import Frontend
from droidw.slam.optimise import Optimiser
from droidw.slam.passes import all_passes, last_passes
from droidw.slam.path import Path
from droidw.slam.restart import contradicted, credit, matched_points, set_out
from droidw.slam.splice import lead, pieces, spliced, support

if TYPE_CHECKING:
    from torch import Tensor

    from droidw.config.schema import DroidwConfig
    from droidw.slam.diagnosis import Diagnosis
    from droidw.slam.passes import Pass
    from droidw.solve.epipolar import PointMatches

__all__ = ["doubted", "track_backwards"]

_log = logging.getLogger(__name__)

Tell = Callable[[int, int], None]


def doubted(
    optimiser: Optimiser,
    config: DroidwConfig,
    found: Diagnosis,
    events: Dispatcher,
    stopped: Callable[[], bool],
) -> Diagnosis:
    """Where too little of what a run measured agrees, let it have what a second look finds better.

    What is too little is less where lines hold the path (`Upright.doubts`). Where next to nothing
    agrees across some interval between keyframes the path has broken there, however much agrees
    elsewhere. Where not quite too little agrees, pieces that points contradict set out anew first:
    a path in the wrong valley agrees with itself, so it is the one they leave that is to be judged.
    Then the way there is adjusted once more, by the measurements that doubt asks for. The way back
    is kept if more of what it measures agrees, and it has not broken where the way there has not;
    then pieces of the way that agrees less in which it agrees more. With what is kept uncertainty
    goes on learning. What fails is left out.

    Args:
        optimiser: of the run; poses, depths and uncertainty of its store may change.
        found: of the run so far.
        stopped: whether the run is to end soon.
    Returns:
        What to say of what is kept.
    """
    options, doubts = config.backend, optimiser.upright.doubts
    broken = found.weakest.broken(options.broken_below)
    in_doubt = broken or doubts(found.agreement, options.backwards_below)
    if not in_doubt and not doubts(found.agreement, options.restart_below):
        return found
    look = _SecondLook(optimiser, config, found, events, stopped)
    optimiser.doubtful = True
    try:
        with optimiser.clock("backwards"):
            if not in_doubt:
                look.set_out_anew()
            if in_doubt or doubts(look.kept.agreement, options.backwards_below):
                _log_why(look.kept, options.broken_below)
                look.run()
    except _Stopped:
        pass
    except Exception as error:  # noqa: BLE001 - what was found forwards is as good as it was
        why = str(error) or type(error).__name__
        events.warn(f"a second look at the keyframes broke off, the best so far is kept: {why}")
    finally:
        optimiser.doubtful, optimiser.points = False, None
    look.kept.write_to(optimiser.store)
    kept = look.kept
    return replace(
        found,
        agreement=kept.agreement,
        weakest=kept.weakest,
        broken=kept.weakest.broken(options.broken_below),
        backwards=look.share,
    )


def _log_why(path: Path, broken_below: float) -> None:
    """Say why keyframes are tracked backwards."""
    if path.weakest.broken(broken_below):
        _log.info(
            "%.0f %% of what was measured across frame %d agrees with poses and depths, the path "
            "has broken there: tracking the keyframes backwards (backend.broken_below=0 does not)",
            100 * path.weakest.share,
            path.weakest.frame,
        )
    else:
        _log.info(
            "%.0f %% of what was measured agrees with poses and depths: tracking the keyframes "
            "backwards (backend.backwards_below=0 does not)",
            100 * path.agreement,
        )


class _SecondLook:
    """What is made of points and of the way back.

    Attributes:
        kept: the best path so far.
        share: of its intervals between keyframes, those from the way back.
    """

    def __init__(
        self,
        optimiser: Optimiser,
        config: DroidwConfig,
        found: Diagnosis,
        events: Dispatcher,
        stopped: Callable[[], bool],
    ) -> None:
        self.optimiser = optimiser
        self.config = config
        self.kept = Path.of(optimiser.store, found.agreement, found.weakest)
        self.share = 0.0
        self._events = events
        self._stopped = stopped
        self._done = 0
        options = config.backend
        # It has been through the wide kernel, which lets weak links drift.
        self._passes = all_passes(options, wide=False)
        self._few = last_passes(options, wide=config.global_solver.cauchy > 0)
        self._finishes = options.relearn or options.motion_prior > 0
        steps = (1 + options.turns * int(self._finishes)) * _updates(self._passes)
        few = 1 + int(options.splice)
        few += 2 * min(options.restarts, options.turns) * int(self._finishes)
        steps += few * _updates(self._few)
        self._total = len(optimiser.store) + steps

    def set_out_anew(self) -> None:
        """Pieces that points contradict, once, with `kept` up to date whenever it is left."""
        matches = matched_points(self.optimiser)
        if matches is None:
            return
        whole, self._total = self._total, 2 * _updates(self._few)
        self._give_say(matches)
        self._restart(matches)
        self.optimiser.points = None
        self._total, self._done = whole, 0

    def run(self) -> None:
        """All of the way back, with `kept` up to date whenever it is left."""
        options = self.config.backend
        # Measured as the way back will be, or neither could be held against the other.
        there = self._adjusted(self.kept, self._few, learn=False)
        before = self._done
        back = track_backwards(
            self.optimiser,
            self.config,
            lambda done, _: self._tell(before + done, self._total),
            self._stopped,
        )
        if back is None:
            return
        better = self._worth(back) > self._worth(there)
        _log.info(
            "%.0f %% agrees, measured once more; %.0f %% backwards%s",
            100 * there.agreement,
            100 * back.agreement,
            ", kept" if better else "",
        )
        self.kept, self.share = (back, 1.0) if better else (there, 0.0)
        if options.splice:
            self._splice(there if better else back)
        if self._finishes:
            self._finish()
        self._events.emit(Progress("backwards", self._total, self._total))

    def _worth(self, path: Path) -> tuple[bool, float]:
        """What is to be larger: one that has not broken comes before one that has."""
        return not path.weakest.broken(self.config.backend.broken_below), path.agreement

    def _splice(self, other: Path) -> None:
        """Take the pieces of another path in which it agrees more."""
        optimiser = self.optimiser
        known = support(optimiser, self.kept)
        ahead = lead(support(optimiser, other), known)
        taken = pieces(ahead)
        if not any(taken):
            return
        inside = torch.tensor(taken)
        joined = spliced(self.kept, other, taken, optimiser.gates())
        found = self._adjusted(joined, self._few, learn=False)
        # Global adjustment may have left what was taken for it.
        gained = float(lead(support(optimiser, found), known)[inside].sum())
        holds = gained > 0
        _log.info(
            "%d pieces of the other way agree more (leads of %.2f, of %.2f after adjustment), %s",
            sum(now and not before for before, now in pairwise([False, *taken])),
            float(ahead[inside].sum()),
            gained,
            "kept" if holds else "left out",
        )
        if holds:
            part = sum(taken) / len(taken)
            self.kept, self.share = found, abs(self.share - part)

    def _restart(self, matches: PointMatches) -> bool:
        """Set out anew from a steady motion where points contradict the path, if that leads on.

        Args:
            matches: of points.
        Returns:
            Whether it does.
        """
        optimiser = self.optimiser
        gates = optimiser.gates()
        motions = contradicted(self.kept, matches, optimiser.store.intrinsics, gates)
        if not motions:
            return False
        known = support(optimiser, self.kept)

        def gain(found: Path) -> Tensor:
            return credit((self.kept, found), (known, support(optimiser, found)), matches)

        other = set_out(optimiser, self.config, self.kept, motions)
        found = self._adjusted(other, self._few, learn=False)
        taken = pieces(gain(found))
        _log.info(
            "points contradict %d of %d motions between keyframes, %d are set out anew",
            len(motions),
            len(taken),
            sum(taken),
        )
        if not any(taken):
            return False
        joined = spliced(self.kept, found, taken, gates)
        found = self._adjusted(joined, self._few, learn=False)
        leads = float(gain(found)[torch.tensor(taken)].sum()) > 0
        if leads:
            self.kept = found
        return leads

    def _give_say(self, matches: PointMatches | None) -> None:
        """Let points count in the adjustments to come."""
        weight = self.config.backend.points
        self.optimiser.points = (matches, weight) if matches is not None and weight > 0 else None

    def _finish(self) -> None:
        """Adjust the path that is kept while uncertainty learns from it and steady motion counts.

        Where little of what stands still is seen, matches agree with whatever path they were
        searched around, and that a camera moves steadily is all that is known. So turns lead the
        same way for long, each less far than the one before: after two of them the next sets out
        from beyond what they found.
        """
        options = self.config.backend
        # What agrees with new weights is nothing to compare with what agreed before.
        agreement = self.kept.agreement
        # Footage that is to be tracked once more needs masks for that, and no better path.
        again = self.optimiser.upright.doubts(agreement, self.config.frontend.again_below)
        last = self.kept
        for turn in range(1 if again else options.turns):
            # What moves is known better with every turn, and so are the points on it.
            self.kept.write_to(self.optimiser.store)
            matches = matched_points(self.optimiser)
            self._give_say(matches)
            restarted = matches is not None and turn < options.restarts and self._restart(matches)
            start = self.kept
            if turn % 3 == 2 and options.beyond > 0 and not restarted:
                start = self.kept.beyond(last, options.beyond)
            found = self._adjusted(
                start, self._passes, learn=options.relearn, motion_prior=options.motion_prior
            )
            last, self.kept = self.kept, replace(found, agreement=agreement)

    def _adjusted(
        self, path: Path, passes: Sequence[Pass], learn: bool, motion_prior: float = 0.0
    ) -> Path:
        """A path after passes of global adjustment."""
        path.write_to(self.optimiser.store)
        before = self._done
        row = replace(self.config.schedule["global"], learn=learn)
        config = replace(
            self.config,
            schedule={**self.config.schedule, "global": row},
            camera=replace(self.config.camera, refine_focal=False),
        )
        backend = Backend(self.optimiser, config, motion_prior=motion_prior, passes=passes)
        backend.run(lambda done, _: self._tell(before + done, self._total))
        return Path.of(self.optimiser.store, backend.agreement, backend.weakest)

    def _tell(self, done: int, total: int) -> None:
        if self._stopped():
            raise _Stopped
        self._done = done
        self._events.emit(Progress("backwards", done, self._total))


def track_backwards(
    optimiser: Optimiser,
    config: DroidwConfig,
    tell: Tell,
    stopped: Callable[[], bool],
) -> Path | None:
    """Track the keyframes of a run from the last one to the first, and adjust them globally.

    It sets off from the last poses and depths of the run. No keyframe is dropped. Uncertainty stays
    as it has learned to be, so that what agrees there and back is weighed alike.

    Args:
        optimiser: of the run, whose store is left as it is.
        tell: called with (keyframes and update steps done, those in all).
        stopped: asked before each of these; whether to give up.
    Returns:
        What was found, in the order of the run and with its first pose; None if there is nothing to
        track, or it was given up.
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
    backend = Backend(frontend.optimiser, config)
    steps = _updates(backend.passes)

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
            number = store.append(info, **values)
            if done >= first:
                frontend.optimiser.upright.turn(number)
            if done == first - 1:
                frontend.resume()
            elif done >= first:
                frontend.grow(forced=True)
        frontend.release()
        backend.run(lambda done, total: told(count + done))
    except _Stopped:
        return None
    optimiser.reports.update(frontend.optimiser.reports)
    return Path.of(store, backend.agreement, backend.weakest).turned(known.T_cw[0])


def _updates(passes: Sequence[Pass]) -> int:
    return sum(part.updates for part in passes)


class _Stopped(Exception):
    """The run is to end."""
