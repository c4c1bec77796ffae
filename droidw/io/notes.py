"""Counting what could not be used, and saying so without flooding."""

from __future__ import annotations

from collections import Counter

__all__ = ["Notes"]

_SHOWN = 5


class Notes:
    """Collects sentences, the first few of a kind as they are and the rest as a count.

    Args:
        problems: the list that receives the sentences.
    Attributes:
        skipped: how many pictures were reported by `skip`.
    """

    def __init__(self, problems: list[str]) -> None:
        self._problems = problems
        self._counts: Counter[str] = Counter()
        self.skipped = 0

    def add(self, sentence: str) -> None:
        """Say something once."""
        self._problems.append(sentence)

    def skip(self, kind: str, sentence: str) -> None:
        """Count a picture left out; `kind` is a plural ("pictures of another size")."""
        self.skipped += 1
        self._counts[kind] += 1
        if self._counts[kind] <= _SHOWN:
            self._problems.append(f"{sentence}, skipped")

    def finish(self) -> None:
        """Say how many of each kind were not listed one by one; call it at the end."""
        for kind, count in self._counts.items():
            if count > _SHOWN:
                self._problems.append(f"{count - _SHOWN} more {kind} skipped")
        self._counts.clear()
