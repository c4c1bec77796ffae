"""The folder of weights: what is there, what it should be, how a file gets in."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droidw.errors import DroidwError, InputError, PluginError, UsageError, did_you_mean
from droidw.io.download import DownloadError, Progress, download, sha256_of
from droidw.io.files import atomic_write
from droidw.io.weights import RECORDS, fingerprint, read_records, read_state
from droidw.plugin.registry import Entry
from droidw.plugin.weights import WeightsFile, find_weights

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Known", "WeightsStore", "catalogue", "require_shapes"]

_SHOWN = 4


@dataclass(frozen=True)
class Known:
    """A weights file, and the parts that ask for it ("depth metric3d"), by whose package."""

    file: WeightsFile
    needed_by: tuple[str, ...] = ()
    distribution: str = ""


def catalogue(entries: Iterable[Entry]) -> dict[str, Known]:
    """Every weights file that a plugin names, by name.

    A bare name that no record describes gets a record without an address.

    Raises:
        PluginError: two plugins describe different files by the same name.
    """
    found: dict[str, Known] = {}
    for entry in entries:
        part = f"{entry.kind} {entry.component.name}"
        for wanted in entry.component.all_weights():
            file = wanted if isinstance(wanted, WeightsFile) else WeightsFile(wanted)
            known = found.get(file.name, Known(file, (), entry.distribution))
            if known.file == WeightsFile(file.name):  # only the name was known so far
                known = Known(file, known.needed_by, entry.distribution)
            elif file not in (known.file, WeightsFile(file.name)):
                raise PluginError(
                    f"the weights '{file.name}' are described differently by {known.distribution} "
                    f"and by {entry.distribution}",
                    f"switch one off: DROIDW_DISABLE_PLUGINS={entry.plugin}",
                )
            if part not in known.needed_by:
                known = replace(known, needed_by=(*known.needed_by, part))
            found[file.name] = known
    return dict(sorted(found.items()))


def require_shapes(
    state: Mapping[str, Tensor],
    shapes: Mapping[str, Sequence[int]],
    optional: Iterable[str] = (),
) -> dict[str, Tensor]:
    """The tensors, if they are exactly those of a network; for `WeightsFile.check`.

    Args:
        state: tensors by key.
        shapes: key -> shape of all that the network has.
        optional: keys that may be missing, and are left out.
    Raises:
        InputError: keys are missing, unknown or of another shape; names the first of each.
    """
    may_lack = set(optional)
    missing = [key for key in shapes if key not in state and key not in may_lack]
    unknown = [key for key in state if key not in shapes and key not in may_lack]
    wrong = [
        f"{key} is {list(state[key].shape)}, should be {list(shape)}"
        for key, shape in shapes.items()
        if key in state and tuple(state[key].shape) != tuple(shape)
    ]
    faults = [
        f"{len(keys)} {what}: " + ", ".join(keys[:_SHOWN]) + (", ..." if keys[_SHOWN:] else "")
        for keys, what in (
            (missing, f"of {len(shapes)} tensors missing"),
            (unknown, "tensors unknown"),
            (wrong, "of another shape"),
        )
        if keys
    ]
    if faults:
        raise InputError("; ".join(faults))
    return {key: state[key] for key in shapes if key in state}


@dataclass
class WeightsStore:
    """A folder of weights and the files that plugins know.

    Attributes:
        folder: made when the first file comes.
        known: what `catalogue` found.
    """

    folder: Path
    known: Mapping[str, Known] = field(default_factory=dict)

    def file(self, name: str) -> WeightsFile:
        """The record of that name, or of that published file name.

        Raises:
            UsageError: there is none; says the nearest and all.
        """
        for known in self.known.values():
            if name in (known.file.name, known.file.file):
                return known.file
        raise UsageError(
            f"no weights are called '{name}'",
            did_you_mean(name, self.known)
            + f"weights: {', '.join(self.known) or 'no plugin names any'}",
        )

    def find(self, file: WeightsFile) -> Path | None:
        """Where it lies, or None."""
        return find_weights(self.folder, file)

    def fetch(
        self,
        name: str,
        *,
        force: bool = False,
        offline: bool = False,
        progress: Progress | None = None,
    ) -> tuple[Path, bool]:
        """Download, check and store a file; one that is there is verified instead.

        Returns:
            Where it lies, and whether it was downloaded.
        Raises:
            UsageError: the name is unknown, or the folder cannot be written.
            DownloadError, MissingRequirementError: as `download`.
            InputError: what came is not what it should be.
        """
        file = self.file(name)
        present = self.find(file)
        if present is not None and not force:
            self.verify(file.name)
            return present, False
        if not file.urls:
            raise InputError(
                f"the weights '{name}' are published at no address",
                "get the file from its authors, and: droidw weights add FILE" + _page(file),
            )
        recorded = read_records(self.folder).get(file.name, {})
        before = str(recorded.get("published_sha256", ""))
        target = self.folder / (".fetched-" + (file.file or file.name + ".pth"))
        try:
            got = download(
                file.urls,
                target,
                sha256=file.sha256 or before,
                sha256_of_before=not file.sha256,
                offline=offline,
                progress=progress,
            )
        except DownloadError as error:
            if "came from there before" in error.message:
                error.hint = f"if a new version is to be trusted: remove {self.folder / RECORDS}"
            raise
        try:
            state = self._checked(file, target, source=got.url)
            path = self._store(file, state, got.url, got.sha256)
        finally:
            target.unlink(missing_ok=True)
        return path, True

    def add(self, path: Path, name: str = "") -> tuple[WeightsFile, Path]:
        """Recognise a file by its tensors, check it, store it as safetensors.

        Args:
            path: the file.
            name: what it is, where that is not to be found out.
        Raises:
            InputError: it cannot be read, is nothing that a plugin knows, or could be several.
            UsageError: there is no such file or name, or the folder cannot be written.
        """
        if not path.is_file():
            raise UsageError(f"{path}: no such file", "type: droidw weights add FILE")
        if name:
            file = self.file(name)
            state = self._checked(file, path)
        else:
            file, state = self._recognised(path)
        return file, self._store(file, state, str(path.resolve()), "")

    def verify(self, name: str) -> str:
        """Check a file on disk: its hash, where one is recorded, and every tensor.

        Returns:
            A sentence about what was checked; a hash that was not recorded is now, if the folder
            can be written to.
        Raises:
            InputError: it has changed, is damaged, or is not what its name says.
            UsageError: the name is unknown, or the file is not there.
        """
        file = self.file(name)
        path = self.find(file)
        if path is None:
            raise UsageError(
                f"the weights '{file.name}' are not in {self.folder}",
                f"download them: droidw weights fetch {file.name}",
            )
        known = self._recorded(path)
        digest = fingerprint(path, afresh=True)
        state = self._checked(file, path)
        said = "hash as recorded" if known else "hash recorded now"
        if not known:
            try:
                self._record(file, path, digest, "found in the folder", "")
            except UsageError:
                said = "hash not recorded, since the folder cannot be written to"
        return f"{path.name}: {said}, {len(state)} tensors fit, SHA-256 {digest}"

    def _recorded(self, path: Path) -> bool:
        return any(row.get("file") == path.name for row in read_records(self.folder).values())

    def _recognised(self, path: Path) -> tuple[WeightsFile, dict[str, Tensor]]:
        raw = read_state(path)
        fits: list[tuple[WeightsFile, dict[str, Tensor]]] = []
        faults: list[str] = []
        for known in self.known.values():
            if not known.file.check:
                continue
            try:
                fits.append((known.file, _run_check(known.file, raw)))
            except InputError as error:
                faults.append(f"{known.file.name}: {error.message}")
        if len(fits) == 1:
            return fits[0]
        if fits:
            raise InputError(
                f"{path} could be any of {', '.join(file.name for file, _ in fits)}",
                f"say which: droidw weights add {path} --name {fits[0][0].name}",
            )
        first = ", ".join(list(raw)[:_SHOWN])
        raise InputError(
            f"{path} is nothing that a plugin knows: its {len(raw)} tensors begin with {first}",
            "\n".join(["it is not", *faults]),
        )

    def _checked(self, file: WeightsFile, path: Path, source: str = "") -> dict[str, Tensor]:
        """The tensors as the network takes them, or an error that names the file."""
        state = read_state(path)
        if not file.check:
            return state
        try:
            return _run_check(file, state)
        except InputError as error:
            raise InputError(
                f"{source or path} is not '{file.name}': {error.message}", error.hint
            ) from error

    def _store(
        self, file: WeightsFile, state: Mapping[str, Tensor], source: str, published: str
    ) -> Path:
        from safetensors import SafetensorError
        from safetensors.torch import save_file

        path = self.folder / f"{file.name}.safetensors"
        hidden = self.folder / f".{path.name}.{os.getpid()}.tmp"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            save_file(
                _separate(state), hidden, metadata={"name": file.name, "licence": file.licence}
            )
            hidden.replace(path)
        except (OSError, SafetensorError) as error:
            raise UsageError(
                f"cannot write {path}: {getattr(error, 'strerror', None) or error}",
                "make room there, or name another folder: DROIDW_WEIGHTS=FOLDER",
            ) from error
        finally:
            with contextlib.suppress(OSError):
                hidden.unlink(missing_ok=True)
        self._record(file, path, sha256_of(path), source, published)
        return path

    def _record(
        self, file: WeightsFile, path: Path, digest: str, source: str, published: str
    ) -> None:
        records = read_records(self.folder)
        stat = path.stat()
        records[file.name] = {
            "file": path.name,
            "sha256": digest,
            "size": stat.st_size,
            "mtime_ns": stat.st_mtime_ns,
            "source": source,
            "published_sha256": published
            or str(records.get(file.name, {}).get("published_sha256", "")),
            "licence": file.licence,
        }
        with atomic_write(self.folder / RECORDS) as stream:
            stream.write(json.dumps(dict(sorted(records.items())), indent=2).encode() + b"\n")


def _separate(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Contiguous tensors of which no two share memory, as safetensors wants them."""
    met: set[int] = set()
    out: dict[str, Tensor] = {}
    for key, value in state.items():
        place = value.untyped_storage().data_ptr()
        out[key] = value.clone().contiguous() if place in met else value.contiguous()
        met.add(place)
    return out


def _run_check(file: WeightsFile, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What the checker makes of the tensors.

    Raises:
        InputError: they do not fit, or the checker itself is at fault.
    """
    try:
        return dict(_checker(file)(state))
    except DroidwError as error:
        raise InputError(error.message, error.hint) from error
    except ImportError as error:
        raise InputError(f"its check cannot be imported ({error})") from error
    except Exception as error:
        raise InputError(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}") from error


def _checker(file: WeightsFile) -> Callable[[Mapping[str, Any]], Mapping[str, Any]]:
    if not isinstance(file.check, str):
        return file.check
    module, _, name = file.check.partition(":")
    function: Callable[[Mapping[str, Any]], Mapping[str, Any]] = getattr(
        importlib.import_module(module), name
    )
    return function


def _page(file: WeightsFile) -> str:
    return f"\nsee: {file.reference}" if file.reference else ""
