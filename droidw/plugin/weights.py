"""`WeightsFile`: what a part says about the trained weights that it needs; and finding them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["SUFFIXES", "WeightsFile", "find_weights", "weights_name"]

SUFFIXES = (".safetensors", ".pth", ".pt", ".bin")
"""Endings under which weights are looked for, the best first."""


@dataclass(frozen=True)
class WeightsFile:
    """One file of trained weights: what it is, where it is published, how it is checked.

    Making one loads nothing. A part names its files in `Component.weights`.

    Attributes:
        name: lower-case kebab, unique among all files, e.g. "acme-small"; what
            `droidw weights fetch` takes and the stem of the file on disk.
        urls: where it is published, tried in this order; http, https or Google Drive.
        size: bytes, about, for the listing; 0 where unknown.
        licence: of the weights, e.g. "CC BY-NC 4.0"; "not stated" where it is not.
        sha256: of the published file in lower-case hex, "" where its authors give none.
        file: name under which it is published ("acme_small_v2.pth"), also found by that name.
        check: function that is handed the tensors by key and returns them as the network takes
            them, or raises with a sentence about what does not fit; strict: every key and every
            shape. As a callable, or lazily as "package.module:function". "" accepts anything,
            which `droidw weights add` then cannot recognise.
        reference: the page or paper that it is from.
    """

    name: str
    urls: tuple[str, ...] = ()
    size: int = 0
    licence: str = "not stated"
    sha256: str = ""
    file: str = ""
    check: str | Callable[[Mapping[str, Any]], Mapping[str, Any]] = field(default="", compare=False)
    reference: str = ""


def weights_name(wanted: str | WeightsFile) -> str:
    """The name of a file, given as record or as name."""
    return wanted.name if isinstance(wanted, WeightsFile) else wanted


def find_weights(folder: Path | None, wanted: str | WeightsFile) -> Path | None:
    """The weights file on disk, or None where it is not there.

    Looked for are NAME.safetensors, NAME.pth, NAME.pt, NAME.bin, NAME itself, and the name under
    which it is published.

    Args:
        folder: the folder of weights, or None where none is set.
        wanted: name without ending ("droid"), or the record.
    """
    if folder is None:
        return None
    name = weights_name(wanted)
    names = [name + suffix for suffix in SUFFIXES] + [name]
    if isinstance(wanted, WeightsFile) and wanted.file:
        names.append(wanted.file)
    return next((folder / n for n in names if (folder / n).is_file()), None)
