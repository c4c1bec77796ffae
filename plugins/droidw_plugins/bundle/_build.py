"""Compiling the kernels at first use, into a cache that all processes of a user share.

A library is found again by the source it was made from, the compiler with its version, the flags
and the processor. Several processes may ask at once: one builds under a lock, the others wait, and
a library appears under its name only when it is whole.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from droidw.plugin.cache import user_cache

__all__ = [
    "CACHE_VARIABLE",
    "BuildError",
    "Recipe",
    "build",
    "compiler_version",
    "failure_of",
    "kernels_dir",
    "source_files",
]

CACHE_VARIABLE = "DROIDW_CACHE"

_SOURCES = Path(__file__).with_name("csrc")
_LINES_SHOWN = 6
_log = logging.getLogger(__name__)


class BuildError(Exception):
    """A library could not be made; the text says why and what to do, in sentences."""


@dataclass(frozen=True)
class Recipe:
    """How a library is made.

    Attributes:
        name: of the library, e.g. "native".
        compiler: path of the compiler.
        version: what the compiler calls itself; part of the key.
        attempts: sets of flags in the order in which they are tried.
        source: file in `csrc/`.
        target: what it is made for: the processor, or the GPU's architecture.
        advice: what to do if the compiler fails.
    """

    name: str
    compiler: str
    version: str
    attempts: tuple[tuple[str, ...], ...]
    source: str
    target: str
    advice: str

    @property
    def key(self) -> str:
        """Twenty hexadecimal digits that stand for everything that decides the result."""
        digest = hashlib.sha256()
        for path in source_files():
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
        digest.update(repr((self.compiler, self.version, self.attempts, self.source)).encode())
        digest.update(f"{self.target} {platform.machine()} {platform.system()}".encode())
        return digest.hexdigest()[:20]


def source_files() -> list[Path]:
    """All kernel sources, in the order of their names."""
    return sorted(path for path in _SOURCES.iterdir() if path.is_file())


def kernels_dir(environ: Mapping[str, str] = os.environ) -> Path:
    """Folder of compiled kernels: `$DROIDW_CACHE/kernels`, or below the user's cache folder."""
    if environ.get(CACHE_VARIABLE):
        return Path(environ[CACHE_VARIABLE]).expanduser() / "kernels"
    return user_cache(environ) / "kernels"


def compiler_version(compiler: str) -> str:
    """What `compiler --version` prints, or "" if it cannot be run."""
    try:
        done = subprocess.run(
            [compiler, "--version"], capture_output=True, text=True, check=False, timeout=60
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def failure_of(recipe: Recipe) -> str:
    """Why the last attempt at exactly this recipe failed, or "" if it did not."""
    note = kernels_dir() / f"{recipe.name}-{recipe.key}.failed"
    try:
        return note.read_text(encoding="utf-8")
    except OSError:
        return ""


def build(recipe: Recipe) -> Path:
    """The library of a recipe: from the cache, or compiled now.

    Raises:
        BuildError: the compiler failed, or the cache cannot be written.
    """
    folder = kernels_dir()
    library = folder / f"{recipe.name}-{recipe.key}{_suffix()}"
    if library.is_file():
        return library
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder / f"{recipe.name}.lock"):
            if not library.is_file():
                _compile(recipe, library)
    except OSError as error:
        raise BuildError(
            f"the cache of compiled kernels {folder} cannot be written ({error}); "
            f"name another folder: {CACHE_VARIABLE}=FOLDER"
        ) from error
    return library


def _compile(recipe: Recipe, library: Path) -> None:
    """Tries one set of flags after the other; leaves a note of the failure if none works."""
    note = library.with_suffix(".failed")
    said = ""
    with tempfile.TemporaryDirectory(dir=library.parent, prefix="build-") as scratch:
        made = Path(scratch) / library.name
        for flags in recipe.attempts:
            command = [recipe.compiler, *flags, str(_SOURCES / recipe.source), "-o", str(made)]
            _log.info("compiling kernels '%s' once: %s", recipe.name, " ".join(command))
            try:
                done = subprocess.run(command, capture_output=True, text=True, check=False)
            except OSError as error:  # it is there, but no program for this machine
                said = said or str(error)
                continue
            if done.returncode == 0 and made.is_file():
                os.replace(made, library)
                note.unlink(missing_ok=True)
                return
            said = said or done.stderr + done.stdout
    lines = [line for line in said.splitlines() if line.strip()][-_LINES_SHOWN:]
    text = f"{recipe.compiler} could not compile the kernels '{recipe.name}'; {recipe.advice}"
    text += "".join(f"\n  {line}" for line in lines)
    note.write_text(text, encoding="utf-8")
    raise BuildError(text)


def _suffix() -> str:
    return {"Windows": ".dll", "Darwin": ".dylib"}.get(platform.system(), ".so")


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Holds an exclusive lock that the system gives back if the process dies."""
    with path.open("a+b") as held:
        if os.name == "nt":
            import msvcrt

            held.seek(0)
            getattr(msvcrt, "locking")(held.fileno(), getattr(msvcrt, "LK_LOCK"), 1)  # noqa: B009
            yield
            return
        import fcntl

        fcntl.flock(held, fcntl.LOCK_EX)
        yield


def first_found(names: Sequence[str]) -> str:
    """Path of the first program of these that exists, or ""."""
    for name in names:
        path = shutil.which(name)
        if path:
            return path
    return ""
