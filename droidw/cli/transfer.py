"""A progress bar for downloads, on the terminal or, sparsely, in a log."""

from __future__ import annotations

import sys
import time
from typing import TextIO

__all__ = ["Bar", "amount"]

_WIDTH = 28
_EVERY = 0.1
_LOG_EVERY = 15.0


def amount(size: int) -> str:
    """Bytes for people: "88 MB", "1.6 GB"; "" for 0."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= factor:
            value = size / factor
            return f"{value:.1f} {unit}" if value < 10 else f"{value:.0f} {unit}"
    return f"{size} B" if size else ""


class Bar:
    """Called with bytes done and in all; draws on stderr.

    Args:
        label: what is being fetched.
        quiet: draw nothing.
        stream: where to; stderr if None.
    """

    def __init__(self, label: str, quiet: bool = False, stream: TextIO | None = None) -> None:
        self._label = label
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._live = self._stream.isatty()
        self._started = self._drawn = time.monotonic()
        self._first = -1
        self._open = False

    def __call__(self, done: int, total: int) -> None:
        """Draw, if it is time to."""
        now = time.monotonic()
        self._first = done if self._first < 0 else self._first
        finished = done == total
        if self._quiet or (
            now - self._drawn < (_EVERY if self._live else _LOG_EVERY)
            and not (finished and self._live)
        ):
            return
        self._drawn = now
        rate = (done - self._first) / max(now - self._started, 1e-3)
        parts = [self._label, amount(done) or "0 B"]
        if total:
            filled = round(_WIDTH * done / total)
            parts[1:] = [
                "#" * filled + "." * (_WIDTH - filled),
                f"{100 * done // total:3d} %",
                f"{amount(done)} of {amount(total)}",
            ]
        parts.append(f"{amount(int(rate)) or '0 B'}/s")
        text = "  ".join(parts)
        print(f"\r\x1b[K{text}" if self._live else text, end="" if self._live else "\n",
              file=self._stream, flush=True)  # fmt: skip
        self._open = self._live

    def close(self) -> None:
        """End the line."""
        if self._open:
            print(file=self._stream, flush=True)
            self._open = False
