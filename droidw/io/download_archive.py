"""Unpacking zip and tar files, never outside the folder that was named."""

from __future__ import annotations

import contextlib
import gzip
import lzma
import shutil
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from droidw.errors import InputError, UsageError

__all__ = ["unpack"]

Progress = Callable[[int, int], None]

_BLOCK = 1 << 20
_DAMAGE = (
    zipfile.BadZipFile, tarfile.TarError, gzip.BadGzipFile, lzma.LZMAError, zlib.error, EOFError,
    RuntimeError,  # of zipfile: it is encrypted, or packed in a way unknown
)  # fmt: skip
_LEFT_OUT = ("__MACOSX", ".DS_Store")


@dataclass(frozen=True)
class _Member:
    """A file in an archive: its path, its size, and how to open it."""

    path: PurePosixPath
    size: int
    open: Callable[[], IO[bytes]]


def unpack(
    archive: Path, folder: Path, *, below: str = "", progress: Progress | None = None
) -> list[Path]:
    """Unpack a .zip, .tar or compressed .tar into a folder.

    All names are checked before anything is written; then all is unpacked into a hidden folder
    inside and moved into place, where a folder that is there already gains what it lacks.

    Args:
        archive: the file; its kind is told by its content.
        folder: where it goes; made if need be.
        below: take only members whose path begins so.
        progress: told of the bytes unpacked and those in all.
    Returns:
        The topmost folders and files that came, in `folder`.
    Raises:
        InputError: it is no archive, is damaged, holds nothing of what is wanted, or names a
            path outside the folder, a link or a device.
        UsageError: the folder cannot be written, or the disk is full.
    """
    with contextlib.ExitStack() as stack:
        members = [
            member
            for member in _members(archive, stack)
            if member.path.as_posix().startswith(below)
            and not any(part in _LEFT_OUT for part in member.path.parts)
        ]
        if not members:
            raise InputError(f"{archive} holds no file" + (f" below {below}" if below else ""))
        total = sum(member.size for member in members)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(folder).free
            if total > free:
                raise UsageError(
                    f"the disk is full: {archive.name} unpacks to {total / 1e9:.1f} GB, and "
                    f"{free / 1e9:.1f} GB are free in {folder}",
                    "make room there, or name another folder",
                )
            hidden = Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix=".unpacking-", dir=folder))
            )
            done = 0
            for member in members:
                place = hidden.joinpath(*member.path.parts)
                place.parent.mkdir(parents=True, exist_ok=True)
                with member.open() as source, place.open("wb") as stream:
                    done += _copy(source, stream, member, archive)
                if progress is not None:
                    progress(done, total)
            tops = sorted({member.path.parts[0] for member in members})
            for top in tops:
                _move(hidden / top, folder / top)
            return [folder / top for top in tops]
        except _DAMAGE as error:
            raise _damaged(archive, error) from error
        except OSError as error:
            raise UsageError(f"cannot unpack {archive} into {folder}: {error}") from error


def _copy(source: IO[bytes], stream: IO[bytes], member: _Member, archive: Path) -> int:
    """Copy one file; more bytes than the archive's own list says are refused (a bomb)."""
    done = 0
    while block := source.read(_BLOCK):
        done += len(block)
        if done > member.size:
            break
        stream.write(block)
    if done != member.size:
        raise _damaged(archive, f"{member.path} has not the size that is stated")
    return done


def _move(source: Path, target: Path) -> None:
    """Move a tree into place; what exists as a folder is filled up, files are replaced."""
    if source.is_dir() and target.is_dir():
        for entry in source.iterdir():
            _move(entry, target / entry.name)
    else:
        source.replace(target)


def _members(archive: Path, stack: contextlib.ExitStack) -> Iterator[_Member]:
    try:
        if zipfile.is_zipfile(archive):
            yield from _of_zip(archive, stack.enter_context(zipfile.ZipFile(archive)))
        else:
            yield from _of_tar(archive, stack.enter_context(tarfile.open(archive)))  # noqa: SIM115 - the stack closes it
    except _DAMAGE as error:
        raise _damaged(archive, error) from error
    except OSError as error:
        raise InputError(f"{archive}: cannot be read: {error.strerror or error}") from error


def _of_zip(archive: Path, opened: zipfile.ZipFile) -> Iterator[_Member]:
    for info in opened.infolist():
        path = _safe(archive, info.filename)
        kind = info.external_attr >> 28  # of the Unix mode; 0 where another system made it
        if kind not in (0, 0o4, 0o10):
            raise InputError(f"{archive} is refused: {info.filename} is a link or a device in it")
        if not info.is_dir():
            yield _Member(path, info.file_size, lambda info=info: opened.open(info))  # type: ignore[misc]


def _of_tar(archive: Path, opened: tarfile.TarFile) -> Iterator[_Member]:
    for info in opened:
        path = _safe(archive, info.name)
        if info.isdir():
            continue
        if not info.isreg():
            raise InputError(f"{archive} is refused: {info.name} is a link or a device in it")

        def reader(info: tarfile.TarInfo = info) -> IO[bytes]:
            source = opened.extractfile(info)
            assert source is not None  # it is a plain file
            return source

        yield _Member(path, info.size, reader)


def _safe(archive: Path, name: str) -> PurePosixPath:
    """The path of a member, if it stays inside."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in (path.parts or ("",))[0] or "\0" in name:
        raise InputError(
            f"{archive} is refused: it would write outside its folder ({name!r})",
            "it is not what it should be; remove it and fetch it again",
        )
    return path


def _damaged(archive: Path, error: object) -> InputError:
    return InputError(
        f"{archive} cannot be unpacked: it is cut short, damaged or no archive ({error})",
        "remove it and fetch it again",
    )
