"""Trained weights on disk: finding them and reading their tensors."""

from __future__ import annotations

import contextlib
import json
import pickle
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droidw.errors import InputError, MissingRequirementError
from droidw.io.download import sha256_of
from droidw.io.download_page import looks_like_html
from droidw.plugin.weights import WeightsFile, find_weights, weights_name

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["RECORDS", "find", "fingerprint", "load_state", "read_records", "read_state"]

RECORDS = "weights.json"
"""File beside the weights that says what each of them is, with its hash."""

_AGAIN = "get it again: droidw weights fetch NAME --force   (names: droidw weights list)"
_WRAPPERS = ("state_dict", "model", "model_state_dict")


def find(folder: Path | None, name: str | WeightsFile) -> Path | None:
    """The weights file on disk, or None; see `droidw.plugin.weights.find_weights`."""
    return find_weights(folder, name)


def load_state(folder: Path | None, name: str | WeightsFile) -> dict[str, Tensor]:
    """The tensors of a weights file by key, on the CPU, as they are stored.

    Args:
        folder: the folder of weights (`BuildContext.weights_dir`).
        name: name without ending ("droid"), or the record, which also knows the published name.
    Raises:
        MissingRequirementError: it is not there; says what to type.
        InputError: as `read_state`, or it has changed since it was fetched.
    """
    path = find(folder, name)
    if path is None:
        stem = weights_name(name)
        raise MissingRequirementError(
            f"the weights '{stem}' are not in {folder or 'any folder: none is set'}",
            f"download them: droidw weights fetch {stem}\n"
            "or, where they are on disk already: droidw weights add FILE",
        )
    if path.name in (row.get("file") for row in read_records(path.parent).values()):
        fingerprint(path)
    return read_state(path)


def read_records(folder: Path) -> dict[str, dict[str, Any]]:
    """What is recorded of the files in a folder of weights, by name; empty where nothing is."""
    try:
        found = json.loads((folder / RECORDS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(found, dict):
        return {}
    return {str(name): row for name, row in found.items() if isinstance(row, dict)}


def fingerprint(path: Path, *, afresh: bool = False) -> str:
    """SHA-256 of a weights file in hex; the recorded one while size and time are as recorded.

    Args:
        path: the file.
        afresh: read the whole file whatever is recorded.
    Raises:
        InputError: it is not the file that was recorded.
    """
    rows = read_records(path.parent).values()
    row = next((row for row in rows if row.get("file") == path.name), {})
    stat = path.stat()
    same = (row.get("size"), row.get("mtime_ns")) == (stat.st_size, stat.st_mtime_ns)
    if same and not afresh:
        return str(row["sha256"])
    digest = sha256_of(path)
    if row and digest != row.get("sha256"):
        raise InputError(
            f"{path} has changed since it was recorded: SHA-256 is {digest}, was "
            f"{row.get('sha256')}",
            "fetch it again: droidw weights fetch --force NAME\n"
            "or, where it was replaced on purpose: droidw weights add FILE",
        )
    return digest


def read_state(path: Path) -> dict[str, Tensor]:
    """The tensors of a .safetensors file or of a torch checkpoint by key, on the CPU.

    A checkpoint may hold them under "state_dict", "model" or "model_state_dict". Pickles are
    read with `weights_only`, so that no code in them runs.

    Raises:
        InputError: it cannot be read, is cut short, is no checkpoint, or holds more than tensors.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(512)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if looks_like_html(head):
        raise InputError(
            f"{path} is a web page, not weights: a site answered with a page instead of the file",
            _AGAIN,
        )
    # Eight bytes of length, then JSON: the ending of the name may be wrong.
    is_safetensors = head[8:9] == b"{" or path.suffix == ".safetensors"
    return _tensors(path, _read_safetensors(path) if is_safetensors else _read_torch(path))


def _read_safetensors(path: Path) -> object:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise _broken(path, error) from error


def _read_torch(path: Path) -> object:
    import torch

    try:
        with _plain_numbers_of_numpy():
            # Mapped into memory: what stands beside the weights (of an optimiser) costs none.
            return torch.load(
                path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path)
            )
    except pickle.UnpicklingError as error:
        if "Unsupported" in str(error) or "GLOBAL" in str(error):
            raise InputError(
                f"{path} is refused: it holds more than tensors, and reading it could run code",
                "get the file from its authors again: droidw weights list",
            ) from error
        raise _broken(path, error) from error
    except Exception as error:  # a file that is cut short may look like anything
        raise _broken(path, error) from error


@contextlib.contextmanager
def _plain_numbers_of_numpy() -> Iterator[None]:
    """Allow numbers of numpy in a checkpoint, which training leaves there: they are only data."""
    import numpy as np
    import torch

    allow = getattr(torch.serialization, "safe_globals", None)  # not in torch 2.4
    if allow is None:
        yield
        return
    scalar = np.float64(0).__reduce__()[0]
    kinds = (np.float64, np.float32, np.int64, np.int32, np.bool_)
    with allow(
        [
            (scalar, "numpy.core.multiarray.scalar"),
            (scalar, "numpy._core.multiarray.scalar"),
            np.dtype,
            *(type(np.dtype(kind)) for kind in kinds),
        ]
    ):
        yield


def _broken(path: Path, error: Exception) -> InputError:
    said = re.sub(r"\[enforce fail[^\]]*\][ .]*", "", str(error)).strip()
    said = re.split(r"\. |\n", said)[0] or type(error).__name__
    return InputError(
        f"{path} cannot be read as weights: it is cut short, damaged or something else ({said})",
        _AGAIN,
    )


def _tensors(path: Path, loaded: object) -> dict[str, Tensor]:
    import torch

    while isinstance(loaded, Mapping):
        inner = [loaded[key] for key in _WRAPPERS if isinstance(loaded.get(key), Mapping)]
        if not inner:
            break
        loaded = inner[0]
    if not isinstance(loaded, Mapping) or not loaded:
        raise InputError(
            f"{path} holds no tensors by name, but {type(loaded).__name__}",
            "weights are a state dict, as torch.save(network.state_dict(), FILE) writes it",
        )
    for key, value in loaded.items():
        if not isinstance(value, torch.Tensor):
            raise InputError(
                f"{path}: '{key}' is no tensor but {type(value).__name__}",
                "weights are a state dict, as torch.save(network.state_dict(), FILE) writes it",
            )
    return {str(key): value for key, value in loaded.items()}
