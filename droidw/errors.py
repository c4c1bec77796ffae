"""What can go wrong, as sentences: each error says what, where, what is valid and what to type.

The class of an error decides the exit code of the command line (`docs/cli.md`).
"""

from __future__ import annotations

import difflib
from collections.abc import Collection

__all__ = [
    "ConfigError",
    "DroidwError",
    "InputError",
    "Interrupted",
    "MissingRequirementError",
    "PluginError",
    "TrackingError",
    "UsageError",
    "did_you_mean",
    "nearest",
]


class DroidwError(Exception):
    """Base of every error that droidw raises on purpose.

    Args:
        message: one sentence that says what is wrong and where.
        hint: what is valid and what to type, shown on lines of its own; may be empty.
    """

    exit_code = 1

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        if not self.hint:
            return self.message
        return self.message + "\n" + "\n".join("  " + line for line in self.hint.splitlines())


class UsageError(DroidwError):
    """The command line or a call was put together wrongly."""

    exit_code = 2


class ConfigError(UsageError):
    """A configuration was refused before anything was loaded."""


class InputError(DroidwError):
    """The footage, a calibration or another input file cannot be used."""

    exit_code = 3


class TrackingError(DroidwError):
    """The footage was read, but no camera motion could be estimated from it."""

    exit_code = 4


class MissingRequirementError(DroidwError):
    """A plugin, an extra, a compiler or a weights file is not there."""

    exit_code = 5


class PluginError(DroidwError):
    """A plugin broke the contract of its kind: its bug, named with its distribution."""

    exit_code = 5


class Interrupted(DroidwError):
    """The run was stopped by a signal; what had been tracked was written.

    Args:
        signum: the signal; the exit code is 128 + signum (130 for Ctrl-C, 143 for SIGTERM).
    """

    def __init__(self, message: str, signum: int, hint: str = "") -> None:
        super().__init__(message, hint)
        self.signum = signum
        self.exit_code = 128 + signum


def nearest(name: str, valid: Collection[str]) -> str:
    """The valid name most like `name`, or "" if none is near.

    A name that goes on where the other ends (`affine`, `affine-softplus`) is near as well, but not
    as near as one with a slip in it.
    """
    names = list(valid)
    begun = [v for v in names if len(name) > 1 and v.startswith(name)]
    begun += [v for v in names if len(v) > 2 and name.startswith(v)]
    for among, cutoff in ((names, 0.8), (begun, 0.0), (names, 0.65)):
        close = difflib.get_close_matches(name, among, n=1, cutoff=cutoff)
        if close:
            return close[0]
    return ""


def did_you_mean(name: str, valid: Collection[str], before: str = "", after: str = "") -> str:
    """How the hint of an error begins that refuses a name: with the nearest valid one.

    Args:
        name: what was given. valid: what could have been.
        before, after: what belongs around the name where it is typed.
    Returns:
        A question and the gap to what follows, or "" if no valid name is near.
    """
    near = nearest(name, valid)
    return f"did you mean '{before}{near}{after}'?   " if near else ""
