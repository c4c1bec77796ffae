"""`droidw data`: list the datasets of the paper, and fetch sequences of them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droidw.errors import UsageError

if TYPE_CHECKING:
    from droidw.io.dataset_tables import DatasetTable, KnownSequence

__all__ = ["HELP", "add_arguments", "main"]

HELP = "list the datasets of the paper, and fetch sequences of them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `droidw data`."""
    parser.add_argument("action", choices=("list", "fetch"), help="what to do")
    parser.add_argument(
        "names",
        metavar="DATASET[:SEQUENCE]",
        nargs="*",
        help="list: only these datasets; fetch: sequences such as bonn:balloon, or whole datasets",
    )
    parser.add_argument(
        "--data", metavar="DIR", help="the folder of datasets, instead of DROIDW_DATA"
    )
    parser.add_argument(
        "--keep", action="store_true", help="fetch: keep the archive after it was unpacked"
    )
    parser.add_argument(
        "--offline", action="store_true", help="fetch: download nothing (also DROIDW_OFFLINE=1)"
    )
    parser.add_argument("--json", action="store_true", help="list: the same facts as JSON")


def main(args: argparse.Namespace) -> int:
    """Do it; 0 when all went well.

    Raises:
        InputError: a dataset or sequence is unknown, or what came is not what it should be.
        DroidwError: as `droidw.io.download.download` and `droidw.io.download_archive.unpack`.
    """
    from droidw.io.dataset_tables import data_root

    root = Path(args.data).expanduser() if args.data else data_root()
    if args.action == "list":
        print(_json(root, args.names) if args.json else _listing(root, args.names))
        return 0
    rows = [row for name in args.names for row in _rows(name)]
    if not rows:
        raise UsageError("nothing is named to fetch", "type: droidw data fetch bonn:balloon")
    for row in rows:
        _fetch(row, root, args)
    return 0


def _tables(names: list[str]) -> list[DatasetTable]:
    from droidw.io.dataset_tables import load_table, table_names

    return [load_table(name.partition(":")[0]) for name in names or table_names()]


def _rows(name: str) -> list[KnownSequence]:
    """The sequences that `bonn:balloon` or `bonn` means."""
    from droidw.io.dataset_tables import load_table

    dataset, colon, sequence = name.partition(":")
    table = load_table(dataset)
    return [table.sequence(sequence)] if colon else list(table.sequences.values())


def _listing(root: Path, names: list[str]) -> str:
    from droidw.cli.render import table as columns

    text: list[str] = []
    for table in _tables(names):
        text.append(f"{table.title}   {table.page}")
        text.append(f"  {table.reference}; data: {table.licence}")
        rows = []
        for row in table.sequences.values():
            there = "there" if (root / row.folder).is_dir() else ""
            ate = "" if row.ate is None else f"published ATE {row.ate:g} {row.unit}"
            rows.append((row.source, ", ".join(row.also), there, ate))
        text += [columns(rows, indent=2), ""]
    text.append(f"folder: {root}   (DROIDW_DATA or --data)")
    return "\n".join(text)


def _json(root: Path, names: list[str]) -> str:
    from droidw.cli.render import as_json

    facts: list[dict[str, Any]] = []
    for table in _tables(names):
        for row in table.sequences.values():
            facts.append(
                {
                    "source": row.source,
                    "also": list(row.also),
                    "path": str(root / row.folder),
                    "present": (root / row.folder).is_dir(),
                    "archive": row.archive,
                    "page": table.page,
                    "licence": table.licence,
                    "reference": table.reference,
                    "camera": dict(row.camera),
                    "published_ate": row.ate,
                    "unit": row.unit,
                }
            )
    return as_json({"folder": str(root), "sequences": facts})


def _fetch(row: KnownSequence, root: Path, args: argparse.Namespace) -> None:
    """Fetch one sequence, with bars for the download and the unpacking."""
    from droidw.cli.transfer import Bar
    from droidw.io.dataset_tables import load_table
    from droidw.io.download_data import fetch_sequence

    bars = [Bar(f"{row.source}{what}", quiet=args.quiet) for what in ("", ", unpacking")]
    try:
        folder, came = fetch_sequence(
            row,
            root,
            keep=args.keep,
            offline=args.offline,
            download_bar=bars[0],
            unpack_bar=bars[1],
        )
    finally:
        for bar in bars:
            bar.close()
    print(f"{row.source}: {folder}" + ("" if came else " (was there already)"))
    if came:
        table = load_table(row.dataset)
        print(f"  {table.reference}; data: {table.licence}")
