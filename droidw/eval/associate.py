"""Which pose of one trajectory belongs to which pose of another, by time stamp."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from droidw.errors import InputError, UsageError

__all__ = ["DEFAULT_MAX_DIFF", "Association", "associate", "uncrossed"]

DEFAULT_MAX_DIFF = 0.02
"""Largest difference of two matched stamps in seconds, unless one asks for another."""


# By how much steps between stamps, and how long they last, may differ from those of another unit,
# as one side may have keyframes alone, or a part.
_COARSER, _LONGER = 30.0, 10.0
# Numbers of frames are told from seconds by how much longer these would last; a reference that may
# have a stamp a second, by how many frames there are as well, as a share of them.
_AS_MANY, _MUCH_LONGER = 0.2, 3.0
# So few pairs say nothing of a reference that lasts so many times as long.
_FEW, _HUGELY_LONGER = 10, 100.0
_INDICES = "these look like frame indices"


@dataclass(frozen=True)
class Association:
    """Matched stamps of an estimate and a reference.

    Attributes:
        est: [M] int64, positions in the estimate, in time order.
        ref: [M] int64, positions in the reference; no position occurs twice.
        diff: [M] float64 seconds, stamp of the estimate (plus offset) minus that of the reference.
        est_total, ref_total: how many stamps there were to match.
        max_diff, offset: what was allowed and added, in seconds.
    """

    est: npt.NDArray[np.int64]
    ref: npt.NDArray[np.int64]
    diff: npt.NDArray[np.float64]
    est_total: int
    ref_total: int
    max_diff: float
    offset: float

    def __len__(self) -> int:
        return len(self.est)

    def __str__(self) -> str:
        worst = float(np.abs(self.diff).max()) if len(self) else 0.0
        return (
            f"{len(self):,} of {self.est_total:,} stamps matched with {self.ref_total:,} of the "
            f"reference; largest difference {worst * 1e3:.1f} ms "
            f"(allowed {self.max_diff * 1e3:g} ms)"
        )


def associate(
    est: npt.NDArray[np.float64],
    ref: npt.NDArray[np.float64],
    max_diff: float = DEFAULT_MAX_DIFF,
    offset: float = 0.0,
    minimum: int = 1,
) -> Association:
    """Match stamps one to one, the closest pairs first.

    A pair is taken when each is the nearest free partner of the other, and again among those left
    over, until no two free stamps are within `max_diff`: the same pairs as taking all pairs in the
    order of their difference.

    Args:
        est: [N] stamps of the estimate, seconds, in any order.
        ref: [M] stamps of the reference, seconds, in any order.
        max_diff: largest difference of a pair in seconds.
        offset: seconds added to the stamps of the estimate first.
        minimum: fewer pairs than this are refused.
    Raises:
        UsageError: if `max_diff` or `offset` is no sensible number.
        InputError: if fewer than `minimum` pairs are found, or those that are found mean nothing,
            as frames of one side are numbered; the message says why it looks so.
    """
    if not (np.isfinite(max_diff) and max_diff >= 0):
        raise UsageError(
            f"the largest time difference must be a number of seconds from 0, not {max_diff}"
        )
    if not np.isfinite(offset):
        raise UsageError(f"the time offset must be a finite number of seconds, not {offset}")
    times_est = np.asarray(est, dtype=np.float64) + offset
    times_ref = np.asarray(ref, dtype=np.float64)
    if not (np.isfinite(times_est).all() and np.isfinite(times_ref).all()):
        raise InputError("a time stamp is not a finite number")
    pairs_est, pairs_ref = _mutual_nearest(times_est, times_ref, max_diff)
    order = np.argsort(times_est[pairs_est], kind="stable")
    pairs_est, pairs_ref = pairs_est[order], pairs_ref[order]
    if len(pairs_est) < minimum:
        raise _refusal(times_est, times_ref, len(pairs_est), minimum, max_diff)
    if counted := _counted(times_est, times_ref, len(pairs_est)):
        said = f"{len(pairs_est)} pairs within {max_diff:g} s are there by chance alone"
        raise InputError(f"the time stamps do not match, {said}: {_INDICES}", _seconds(counted))
    return Association(
        est=pairs_est,
        ref=pairs_ref,
        diff=times_est[pairs_est] - times_ref[pairs_ref],
        est_total=len(times_est),
        ref_total=len(times_ref),
        max_diff=max_diff,
        offset=offset,
    )


def uncrossed(
    times: npt.NDArray[np.float64], diff: npt.NDArray[np.float64]
) -> npt.NDArray[np.bool_]:
    """Which pairs [M] to keep so that none crosses another, those that are closest first.

    Where more than the distance of two stamps is allowed, a stamp whose own partner is missing may
    go with one beyond those of its neighbours; along such pairs the camera would go to and fro.

    Args:
        times: [M] of the reference, in the order of the estimate. diff: [M] of each pair, seconds.
    """
    keep = np.ones(len(times), dtype=bool)
    if (np.diff(times) >= 0).all():
        return keep
    rows: list[int] = []  # kept so far; their times rise with them
    for row in np.argsort(np.abs(diff), kind="stable").tolist():
        place = bisect_left(rows, row)
        after = place == 0 or times[rows[place - 1]] <= times[row]
        before = place == len(rows) or times[row] <= times[rows[place]]
        keep[row] = after and before
        if keep[row]:
            rows.insert(place, row)
    return keep


def _mutual_nearest(
    est: npt.NDArray[np.float64], ref: npt.NDArray[np.float64], max_diff: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    free_est = np.argsort(est, kind="stable")
    free_ref = np.argsort(ref, kind="stable")
    out_est: list[npt.NDArray[np.int64]] = []
    out_ref: list[npt.NDArray[np.int64]] = []
    while len(free_est) and len(free_ref):
        to_ref = _nearest(est[free_est], ref[free_ref])
        to_est = _nearest(ref[free_ref], est[free_est])
        near = np.abs(est[free_est] - ref[free_ref][to_ref]) <= max_diff
        mutual = near & (to_est[to_ref] == np.arange(len(free_est)))
        if not near.any():
            break
        if not mutual.any():
            # Ties can turn in a circle (equal stamps); the closest pair breaks it.
            gap = np.where(near, np.abs(est[free_est] - ref[free_ref][to_ref]), np.inf)
            mutual[int(np.argmin(gap))] = True
        out_est.append(free_est[mutual])
        out_ref.append(free_ref[to_ref[mutual]])
        keep_ref = np.ones(len(free_ref), dtype=bool)
        keep_ref[to_ref[mutual]] = False
        # A stamp with no partner left within reach can never find one later.
        free_est, free_ref = free_est[near & ~mutual], free_ref[keep_ref]
    if not out_est:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    return np.concatenate(out_est), np.concatenate(out_ref)


def _nearest(
    values: npt.NDArray[np.float64], among: npt.NDArray[np.float64]
) -> npt.NDArray[np.int64]:
    """Position in the sorted `among` of the entry nearest to each value; the earlier on a tie."""
    right = np.clip(np.searchsorted(among, values), 0, len(among) - 1)
    left = np.maximum(right - 1, 0)
    take_left = np.abs(values - among[left]) <= np.abs(values - among[right])
    nearest = np.where(take_left, left, right)
    # The first among equal stamps, so that both directions agree on one of them.
    return np.searchsorted(among, among[nearest], side="left").astype(np.int64)


def _refusal(
    est: npt.NDArray[np.float64],
    ref: npt.NDArray[np.float64],
    found: int,
    minimum: int,
    max_diff: float,
) -> InputError:
    def span(times: npt.NDArray[np.float64]) -> str:
        if not len(times):
            return "no stamps"
        return f"{len(times):,} stamps {times.min():.10g}-{times.max():.10g} s"

    said = (
        f"the time stamps do not match: {found} pairs within {max_diff:g} s, at least {minimum} "
        f"are needed; ref {span(ref)}, est {span(est)}"
    )
    guess = _guess(est, ref, minimum)
    return InputError(said + (f": {guess[0]}" if guess[0] else ""), guess[1])


def _guess(
    est: npt.NDArray[np.float64], ref: npt.NDArray[np.float64], minimum: int
) -> tuple[str, str]:
    """What the stamps look like, and what to do about it."""
    if not len(est) or not len(ref):
        return "", "give a trajectory with at least one pose a line: t tx ty tz qx qy qz qw"
    for times, word in ((est, "estimate"), (ref, "reference")):
        if len(np.unique(times)) < minimum:
            return f"the {word} has fewer", "give one with more poses, each with a time of its own"
    # By steps and by how long it lasts: a clock that starts elsewhere, or a part, has the same.
    steps, spans = _spacing(est) / _spacing(ref), _lasting(est) / _lasting(ref)
    for factor, unit in ((1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds")):
        for step, span, word in ((steps, spans, "estimate"), (1 / steps, 1 / spans, "reference")):
            coarser = factor / _COARSER < step < factor * _COARSER
            # Nothing else has steps of a million seconds, however short the part of a sequence is.
            longer = _LONGER if factor < 1e6 else _COARSER * _LONGER**2
            if coarser and factor / longer < span < factor * longer:
                return (
                    f"the {word} looks like {unit}",
                    f"divide the first column of the {word} by {factor:.0e}",
                )
    for mine, other, word in ((est, ref, "estimate"), (ref, est, "reference")):
        if _like_indices(mine) and not _like_indices(other):
            return _INDICES, _seconds(word)
    gap = max(est.min() - ref.max(), ref.min() - est.max())
    if gap > 0:
        shift = ref.min() - est.min()
        return (
            f"they lie {gap:.6g} s apart",
            "is it the reference of another sequence? if only the clocks differ: "
            f"--t-offset {shift:.6f}",
        )
    nearest = float(np.abs(est - np.sort(ref)[_nearest(est, np.sort(ref))]).min())
    return (
        f"the nearest two are {nearest:.4g} s apart",
        "if the clocks are that coarse: --t-max-diff SECONDS",
    )


def _spacing(times: npt.NDArray[np.float64]) -> float:
    """The usual step between stamps in time order; 1 where there is none."""
    steps = np.diff(np.sort(times))
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 1.0


def _counted(est: npt.NDArray[np.float64], ref: npt.NDArray[np.float64], pairs: int) -> str:
    """Which side has numbers of frames, while the other has seconds; empty: neither.

    As seconds they would last far longer. Truth can: a run may have ended early, and truth may have
    a stamp a second; but not just as many seconds as the other side has frames, nor a hundred times
    as long for a handful of pairs.
    """
    if len(est) < 2 or len(ref) < 2:
        return ""
    if _like_indices(est) and not _like_indices(ref):
        return "estimate" if est.max() > _MUCH_LONGER * np.ptp(ref) else ""
    if _like_indices(ref) and not _like_indices(est):
        as_many = abs(ref.max() + 1 - len(est)) < _AS_MANY * len(est)
        longer = ref.max() / max(float(np.ptp(est)), 1e-9)
        chance = (as_many and longer > _MUCH_LONGER) or (pairs < _FEW and longer > _HUGELY_LONGER)
        return "reference" if chance else ""
    return ""


def _seconds(word: str) -> str:
    return f"write the {word} with the seconds of its frames (the first column of rgb.txt)"


def _lasting(times: npt.NDArray[np.float64]) -> float:
    """From the first stamp to the last; 1 where that is nothing."""
    return float(np.ptp(times)) or 1.0


def _like_indices(times: npt.NDArray[np.float64]) -> bool:
    """Whole numbers that count up from near 0."""
    if len(times) < 2:
        return False
    whole = bool((times == np.round(times)).all())
    return whole and 0 <= float(times.min()) <= 1 and float(np.median(np.diff(times))) >= 1
