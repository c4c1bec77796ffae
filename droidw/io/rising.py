"""Times that rise, out of some that stray."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

__all__ = ["longest_rising", "rising"]


def longest_rising(values: Sequence[float]) -> list[int]:
    """Where the longest part lies whose values strictly rise, in order."""
    tails: list[int] = []
    ends: list[float] = []
    before: list[int] = [-1] * len(values)
    for i, value in enumerate(values):
        at = bisect.bisect_left(ends, value)
        before[i] = tails[at - 1] if at else -1
        if at == len(ends):
            ends.append(value)
            tails.append(i)
        elif value < ends[at]:
            ends[at] = value
            tails[at] = i
    kept = []
    i = tails[-1] if tails else -1
    while i >= 0:
        kept.append(i)
        i = before[i]
    return kept[::-1]


def rising(values: Sequence[float]) -> list[int]:
    """Where each value is larger than all before it; the longest part, where that is longer.

    So a value that runs backwards is left out, and not the one before it; but one that strays far
    ahead costs no other.
    """
    kept: list[int] = []
    for i, value in enumerate(values):
        if not kept or value > values[kept[-1]]:
            kept.append(i)
    longest = longest_rising(values)
    return longest if len(longest) > len(kept) else kept
