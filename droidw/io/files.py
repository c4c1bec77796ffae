"""Writing a file completely or not at all, and reading text with clear errors."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from droidw.errors import InputError, UsageError

__all__ = ["atomic_write", "read_text", "write_json", "write_text"]


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """Open `path` for binary writing so that it is replaced only when all went well.

    The bytes go to a hidden file beside it, which is renamed at the end and removed on error.

    Raises:
        UsageError: the folder cannot be written to, or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            yield stream
        temporary.replace(path)
    except OSError as error:
        raise UsageError(
            f"cannot write {path}: {error.strerror or error}",
            "choose another output folder with -o RUNDIR, or make this one writable",
        ) from error
    finally:
        with suppress(OSError):  # what could not be made cannot be removed either
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a file as a whole or not at all.

    Raises:
        UsageError: as `atomic_write`.
    """
    with atomic_write(path) as stream:
        stream.write(text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write JSON as a whole or not at all.

    Raises:
        UsageError: as `atomic_write`. ValueError: a number is not finite.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_text(path: Path, what: str) -> str:
    """The text of a file; `what` names it in messages ("a trajectory").

    Raises:
        InputError: it does not exist, is a folder, cannot be read or is no text.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file", f"expected {what}") from error
    except IsADirectoryError as error:
        raise InputError(f"{path} is a folder", f"expected a file with {what}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file", f"expected {what}") from error
    if "\0" in text:
        raise InputError(f"{path} is not a text file", f"expected {what}")
    return text
