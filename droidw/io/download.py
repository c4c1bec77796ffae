"""Downloading one file: resumed after a break, checked, and never there by half."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import http.client
import json
import os
import re
import shutil
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from http.cookiejar import CookieJar
from pathlib import Path
from typing import IO, Any

from droidw.errors import DroidwError, MissingRequirementError, UsageError
from droidw.io.download_page import confirmed_link, looks_like_html, page_title

__all__ = [
    "OFFLINE_VARIABLE",
    "DownloadError",
    "Fetched",
    "Progress",
    "download",
    "is_offline",
    "sha256_of",
]

OFFLINE_VARIABLE = "DROIDW_OFFLINE"
"""Set to anything but 0 or nothing, it forbids every download."""

Progress = Callable[[int, int], None]
"""Called with the bytes that are there and the bytes in all (0: unknown)."""

_CHUNK = 1 << 18
_PAGE_LIMIT = 1 << 20
_DIGEST = re.compile(r"[0-9a-f]{64}")
_FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}


class DownloadError(DroidwError):
    """A file could not be had from where it is published."""

    exit_code = 5


class _TryAgain(Exception):
    """The connection broke, or the server asks to wait."""


@dataclass(frozen=True)
class Fetched:
    """A file that was downloaded: where it lies, where it is from, SHA-256 in hex, bytes."""

    path: Path
    url: str
    sha256: str
    size: int


def is_offline(environ: Mapping[str, str] = os.environ) -> bool:
    """Whether `DROIDW_OFFLINE` forbids downloads."""
    return environ.get(OFFLINE_VARIABLE, "") not in ("", "0")


def sha256_of(path: Path) -> str:
    """SHA-256 of a file in lower-case hex."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def download(
    urls: Sequence[str],
    target: Path,
    *,
    sha256: str = "",
    sha256_of_before: bool = False,
    progress: Progress | None = None,
    offline: bool = False,
    attempts: int = 5,
    pause: float = 1.0,
    timeout: float = 30.0,
) -> Fetched:
    """Download a file, from the first of several addresses that has it.

    The bytes go to TARGET.part, which stays after a break and is gone on with next time; the
    target appears whole. A web page in place of the file is refused, Google Drive's question
    about large files answered.

    Args:
        urls: http or https.
        target: the file to make; its folder is made as well.
        sha256: what the file must have; "" takes what the server itself states, if it does.
        sha256_of_before: that hash is not published, but of what came from there before.
        progress: told of every block.
        offline: forbid it, as `DROIDW_OFFLINE` does.
        attempts: how often in a row a connection may break without a byte gained.
        pause: seconds before the second attempt, doubled for each later one.
        timeout: seconds of silence after which a connection counts as broken.
    Raises:
        MissingRequirementError: downloads are forbidden.
        UsageError: the folder cannot be written, or the disk is full.
        DownloadError: no address gave the file; says what each answered.
    """
    if offline or is_offline():
        why = "--offline" if offline else OFFLINE_VARIABLE
        raise MissingRequirementError(
            f"{target.name} is not here, and {why} forbids downloading it",
            "download it elsewhere from " + " or ".join(urls),
        )
    said: list[str] = []
    with _locked_part(target) as part:
        begun = _begun(part).get("url")
        for url in sorted(urls, key=lambda one: one != begun):
            transfer = _Transfer(url, target, part, progress, timeout)
            try:
                transfer.run(attempts, pause)
                transfer.check(sha256, sha256_of_before)
            except DownloadError as error:
                said.append(error.message)
                continue
            found = Fetched(target, url, transfer.digest, transfer.size)
            os.replace(part, target)
            transfer.notes.unlink(missing_ok=True)
            return found
        some = part.stat().st_size > 0
    raise DownloadError(
        "; ".join(said) or f"{target.name} is published nowhere",
        "type the command again: it goes on where it stopped"
        if some
        else "try again later, or download it in a browser",
    )


@contextlib.contextmanager
def _locked_part(target: Path) -> Iterator[Path]:
    """The file beside the target that receives the bytes, held by this process alone."""
    part = target.with_name(target.name + ".part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        stream = part.open("ab")
    except OSError as error:
        raise _unwritable(target, error) from error
    with stream:
        try:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:  # a system without file locks
            pass
        except OSError as error:
            raise DownloadError(
                f"{target} is being downloaded by another process", "wait until it has finished"
            ) from error
        yield part
    if part.is_file() and part.stat().st_size == 0:
        part.unlink()


def _begun(part: Path) -> dict[str, str]:
    """Where the bytes that are here are from, `url`, and what marked their version, `tag`."""
    try:
        notes = json.loads(_notes(part).read_text())
        return {"url": str(notes["url"]), "tag": str(notes["tag"])}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _notes(part: Path) -> Path:
    """The file beside the bytes that says where they are from."""
    return part.with_name(part.name + ".json")


def _unwritable(target: Path, error: OSError) -> UsageError:
    if error.errno in _FULL:
        return UsageError(
            f"the disk is full: {target} could not be written",
            f"make room in {target.parent}, and type the command again: it goes on where it "
            "stopped",
        )
    return UsageError(
        f"cannot write {target}: {error.strerror or error}",
        "make that folder writable, or choose another one",
    )


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows redirections, but not to a lesser protocol; notes what they state of the file."""

    def __init__(self) -> None:
        self.digest = ""

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> Any:
        # Hugging Face names the SHA-256 of large files in the answer that redirects to them.
        stated = str(headers.get("X-Linked-Etag", "")).strip('"')
        if _DIGEST.fullmatch(stated):
            self.digest = stated
        scheme = urllib.parse.urlsplit(newurl).scheme
        if scheme != "https" and not (scheme == "http" and req.type == "http"):
            raise DownloadError(f"{req.full_url} redirects to {newurl}, which is not safe")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


@dataclass
class _Transfer:
    """One address, one file."""

    url: str
    target: Path
    part: Path
    progress: Progress | None
    timeout: float
    digest: str = ""
    size: int = 0
    total: int = 0
    confirmed: bool = False
    ours: bool = False
    broken: bool = False
    redirects: _Redirects = field(default_factory=_Redirects)

    def __post_init__(self) -> None:
        if urllib.parse.urlsplit(self.url).scheme not in ("http", "https"):
            raise DownloadError(f"{self.url} is no http or https address")
        self.notes = _notes(self.part)
        self.address = self.url
        begun = _begun(self.part)
        # Bytes from another address stay until this one has some: it may have nothing.
        self.ours = begun.get("url") == self.url
        self.tag = begun["tag"] if self.ours and self._have() else ""
        self.opener = urllib.request.build_opener(
            self.redirects, urllib.request.HTTPCookieProcessor(CookieJar())
        )

    def run(self, attempts: int, pause: float) -> None:
        """Ask until all bytes are here."""
        failures = 0
        while True:
            before = self._have()
            try:
                if self._ask():
                    return
                continue
            except _TryAgain as error:
                failures = 1 if self._have() > before else failures + 1
                if failures >= attempts:
                    raise DownloadError(
                        f"{self.url}: {error}, {attempts} times in a row"
                    ) from error
                time.sleep(pause * 2 ** (failures - 1))

    def check(self, sha256: str, of_before: bool) -> None:
        """Compare with what is published, or came before; a wrong file is removed."""
        self.digest = sha256_of(self.part)
        self.size = self._have()
        wanted = sha256.lower() or self.redirects.digest
        if wanted and wanted != self.digest:
            self._truncate()
            whose = "came from there before" if sha256 and of_before else "its authors publish"
            raise DownloadError(
                f"{self.url} is not the file that {whose}: SHA-256 is {self.digest}, should be "
                f"{wanted}; it was removed"
            )

    def _have(self) -> int:
        """Bytes from this address that are here."""
        return self.part.stat().st_size if self.ours else 0

    def _truncate(self) -> None:
        os.truncate(self.part, 0)
        self.ours = True
        self.notes.unlink(missing_ok=True)

    def _ask(self) -> bool:
        """One request; whether the file is complete (False: ask at once again)."""
        have = self._have()
        headers = {"User-Agent": "droidw", "Accept-Encoding": "identity"}
        if have:
            headers["Range"] = f"bytes={have}-"
            if self.tag:
                headers["If-Range"] = self.tag
        try:
            with self.opener.open(
                urllib.request.Request(self.address, headers=headers), timeout=self.timeout
            ) as answer:
                return self._receive(answer, have)
        except urllib.error.HTTPError as error:
            with error:
                return self._refused(error, have)
        except (urllib.error.URLError, http.client.HTTPException, ConnectionError) as error:
            raise _TryAgain(f"no connection ({getattr(error, 'reason', error)})") from error
        except TimeoutError as error:
            raise _TryAgain(f"no answer for {self.timeout:g} s") from error

    def _refused(self, error: urllib.error.HTTPError, have: int) -> bool:
        if error.code == 416 and have:
            stated = re.fullmatch(r"bytes \*/(\d+)", error.headers.get("Content-Range", ""))
            if stated and int(stated[1]) == have:
                return True
            self._truncate()
            return False
        if error.code >= 500 or error.code in (408, 429):
            raise _TryAgain(f"the server answers {error.code} {error.reason}")
        raise DownloadError(f"{self.url}: the server answers {error.code} {error.reason}")

    def _receive(self, answer: Any, have: int) -> bool:
        length = int(answer.headers.get("Content-Length") or 0)
        if have and answer.status != 206:  # it has changed, or this server cannot go on
            self._truncate()
            have = 0
        elif have and not self._fits(answer.headers.get("Content-Range", ""), have):
            self._truncate()
            return False
        self.broken = False
        block = self._read(answer)
        if have == 0 and looks_like_html(block):
            return self._page(answer, block)
        if not self.ours:
            self._truncate()
        tag = answer.headers.get("ETag", "")
        self.tag = tag if tag and not tag.startswith("W/") else ""
        self.tag = self.tag or answer.headers.get("Last-Modified", "")
        self.total = have + length if length else 0
        try:
            self._make_room(length)
            if self.tag:  # without one, what has come cannot be gone on with next time
                self.notes.write_text(json.dumps({"url": self.url, "tag": self.tag}))
            with self.part.open("ab") as stream:
                while block:
                    self._write(stream, block)
                    have += len(block)
                    if self.progress is not None:
                        self.progress(have, self.total)
                    block = self._read(answer)
        except OSError as error:  # `_read` turns those of the network into _TryAgain
            raise _unwritable(self.target, error) from error
        if have < self.total:
            raise _TryAgain(f"the connection broke after {have} of {self.total} bytes")
        return True

    def _fits(self, stated: str, have: int) -> bool:
        """Whether a part of the file begins where the bytes here end, and is of the same file."""
        match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", stated)
        if match is None or int(match[1]) != have:
            return False
        return match[2] == "*" or self.total in (0, int(match[2]))

    def _make_room(self, length: int) -> None:
        free = shutil.disk_usage(self.part.parent).free
        if length > free:
            raise OSError(errno.ENOSPC, f"{length} bytes are to come, {free} are free")

    @staticmethod
    def _write(stream: IO[bytes], block: bytes) -> None:
        stream.write(block)

    def _read(self, answer: Any) -> bytes:
        if self.broken:
            raise _TryAgain("the connection broke")
        try:
            return bytes(answer.read(_CHUNK))
        except http.client.IncompleteRead as error:
            # What has come is kept first. A file sent without its length would end there.
            self.broken = True
            return bytes(error.partial) or self._read(answer)
        except (OSError, http.client.HTTPException) as error:
            raise _TryAgain(f"the connection broke ({error})") from error

    def _page(self, answer: Any, start: bytes) -> bool:
        """A web page came: follow Google Drive's confirmation once, refuse all else."""
        page = (start + bytes(answer.read(_PAGE_LIMIT))).decode("utf-8", "replace")
        link = "" if self.confirmed else confirmed_link(answer.geturl(), page)
        if link:
            self.confirmed, self.address = True, link
            return False
        title = page_title(page)
        raise DownloadError(
            f"{self.url} answers with a web page instead of the file"
            + (f" ('{title}')" if title else "")
        )
