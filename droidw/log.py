"""Logging for the command line and for the library; the only place that touches handlers.

Every module logs to `logging.getLogger(__name__)`, and so below "droidw" or "droidw_plugins".
"""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

__all__ = ["log_to_file", "quiet_library", "set_up"]

if TYPE_CHECKING:
    _Stream = logging.StreamHandler[TextIO]
else:  # generic only since Python 3.11
    _Stream = logging.StreamHandler

_ROOTS = ("droidw", "droidw_plugins")


class _Sentence(logging.Formatter):
    """`droidw: warning: text`; plain text for information."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        if record.levelno == logging.INFO:
            return text
        return f"droidw: {record.levelname.lower()}: {text}"


class _Console(_Stream):
    """The handler that `set_up` puts in place, recognisable so that it is never doubled."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, on a terminal over the live line that may stand there."""
        if not self.stream.closed and self.stream.isatty():
            self.stream.write("\r\x1b[K")
        super().emit(record)


def quiet_library() -> None:
    """Let a program that imports droidw decide about logging: a handler that drops everything."""
    for name in _ROOTS:
        logger = logging.getLogger(name)
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())


def set_up(verbosity: int = 0, stream: TextIO | None = None) -> None:
    """Log to a terminal; calling it again replaces what an earlier call set up.

    Args:
        verbosity: -1 errors only, 0 warnings, 1 information, 2 and more everything.
        stream: standard error unless given.
    """
    levels = {-1: logging.ERROR, 0: logging.WARNING, 1: logging.INFO}
    level = levels.get(max(verbosity, -1), logging.DEBUG)
    handler = _Console(stream or sys.stderr)
    handler.setFormatter(_Sentence("%(message)s"))
    handler.setLevel(level)
    for name in _ROOTS:
        logger = logging.getLogger(name)
        logger.handlers = [h for h in logger.handlers if not isinstance(h, _Console)]
        logger.addHandler(handler)
        logger.setLevel(min(level, logging.INFO))


@contextlib.contextmanager
def log_to_file(path: Path, level: int = logging.INFO) -> Iterator[None]:
    """Append what is logged inside the `with` block to a file, one stamped line per record.

    Raises:
        OSError: the file cannot be opened.
    """
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.setLevel(level)
    before = {name: logging.getLogger(name).level for name in _ROOTS}
    for name in _ROOTS:
        logger = logging.getLogger(name)
        logger.addHandler(handler)
        logger.setLevel(min(logger.getEffectiveLevel(), level))
    try:
        yield
    finally:
        for name, old in before.items():
            logging.getLogger(name).removeHandler(handler)
            logging.getLogger(name).setLevel(old)
        handler.close()
