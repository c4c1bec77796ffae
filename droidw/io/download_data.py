"""Fetching a sequence of a known dataset: download, compare, unpack."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from droidw.errors import InputError
from droidw.io.dataset_tables import KnownSequence, load_table
from droidw.io.download import Progress, download, sha256_of
from droidw.io.download_archive import unpack
from droidw.io.files import atomic_write

__all__ = ["RECORDS", "fetch_sequence"]

RECORDS = "downloads.json"
"""File in the folder of datasets: address -> hash and size of what came from there."""


def fetch_sequence(
    row: KnownSequence,
    root: Path,
    *,
    keep: bool = False,
    offline: bool = False,
    download_bar: Progress | None = None,
    unpack_bar: Progress | None = None,
) -> tuple[Path, bool]:
    """Bring a sequence into the folder of datasets.

    None of the datasets publishes a hash: that of the first download is kept and compared later.
    An archive that broke off while it was unpacked is still there and is not downloaded again.

    Args:
        row: the sequence.
        root: the folder of datasets.
        keep: keep the archive.
        offline: forbid downloads.
        download_bar, unpack_bar: told of the progress.
    Returns:
        Its folder, and whether it had to be fetched.
    Raises:
        InputError: it can only be had by hand, or what came is not what it should be.
        DroidwError: as `download` and `unpack`.
    """
    folder = root / row.folder
    if folder.is_dir():
        return folder, False
    if not row.archive:
        raise InputError(
            f"{row.source} cannot be fetched: it is published where no program can take it from",
            f"download it by hand from {load_table(row.dataset).page}\nand put it at {folder}",
        )
    target = root / row.archive.rpartition("/")[2]
    wanted = str(_records(root).get(row.archive, {}).get("sha256", ""))
    if not (target.is_file() and wanted and sha256_of(target) == wanted):
        got = download(
            [row.archive],
            target,
            sha256=wanted,
            sha256_of_before=True,
            offline=offline,
            progress=download_bar,
        )
        _record(root, row.archive, {"sha256": got.sha256, "size": got.size})
    unpack(target, root / row.unpack, below=row.below, progress=unpack_bar)
    if not folder.is_dir():
        raise InputError(
            f"{target} was unpacked, but there is no {folder}: its authors have changed its layout",
            f"look into {root / row.unpack}, and run on the folder by its path",
        )
    if not keep:
        target.unlink()
    return folder, True


def _records(root: Path) -> dict[str, dict[str, Any]]:
    try:
        found = json.loads((root / RECORDS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _record(root: Path, address: str, facts: dict[str, Any]) -> None:
    known = {**_records(root), address: facts}
    with atomic_write(root / RECORDS) as stream:
        stream.write(json.dumps(known, indent=2, sort_keys=True).encode() + b"\n")
