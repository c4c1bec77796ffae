"""`droidw weights`: list, fetch, add and verify the trained weights that parts need."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droidw.cli.options import add_plugin_arguments, plugins_from
from droidw.errors import DroidwError, UsageError

if TYPE_CHECKING:
    from droidw.io.weights_store import WeightsStore

__all__ = ["HELP", "add_arguments", "main"]

HELP = "list, fetch, add and verify the trained weights that parts need"

_ACTIONS = ("list", "fetch", "add", "verify")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `droidw weights`."""
    parser.add_argument("action", choices=_ACTIONS, help="what to do")
    parser.add_argument(
        "names",
        metavar="NAME|FILE",
        nargs="*",
        help="list, fetch, verify: names from the list (list: all; verify: all that are there); "
        "add: files",
    )
    parser.add_argument("--all", action="store_true", help="fetch: everything in the list")
    parser.add_argument(
        "--name", metavar="NAME", default="", help="add: what the file is, if it cannot be told"
    )
    parser.add_argument(
        "--force", action="store_true", help="fetch: download again what is there already"
    )
    parser.add_argument(
        "--offline", action="store_true", help="fetch: download nothing (also DROIDW_OFFLINE=1)"
    )
    parser.add_argument(
        "--folder", metavar="DIR", help="the folder of weights, instead of DROIDW_WEIGHTS"
    )
    parser.add_argument("--json", action="store_true", help="list: the same facts as JSON")
    add_plugin_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Do it; 0 when all went well.

    Raises:
        DroidwError: as `WeightsStore`.
    """
    from droidw.io.weights_store import WeightsStore, catalogue

    plugins = plugins_from(args, tolerant=args.action == "list")
    folder = Path(args.folder).expanduser() if args.folder else plugins.weights_dir
    store = WeightsStore(folder, catalogue(plugins.entries()))
    if args.action == "list":
        if args.names:
            asked = {store.file(name).name for name in args.names}
            store.known = {name: known for name, known in store.known.items() if name in asked}
        print(_json(store) if args.json else _listing(store))
        return 0
    if args.action == "verify":
        return _verify(store, args.names)
    if args.action == "add":
        return _add(store, args.names, args.name)
    return _fetch(store, args)


def _listing(store: WeightsStore) -> str:
    from droidw.cli.render import table
    from droidw.cli.transfer import amount

    if not store.known:
        return "no part needs weights"
    rows = [("name", "size", "there", "needed by", "licence")]
    for known in store.known.values():
        file, path = known.file, store.find(known.file)
        size = amount(path.stat().st_size) if path else "~" + (amount(file.size) or "?")
        there = path.name if path else "no"
        rows.append((file.name, size, there, ", ".join(known.needed_by), file.licence))
    missing = [k.file.name for k in store.known.values() if store.find(k.file) is None]
    text = [table(rows), "", f"folder: {store.folder}"]
    if missing:
        text.append(f"download: droidw weights fetch {missing[0]}   (or --all)")
    return "\n".join(text)


def _json(store: WeightsStore) -> str:
    from droidw.cli.render import as_json
    from droidw.io.weights import read_records

    records = read_records(store.folder)
    facts: list[dict[str, Any]] = []
    for name, known in store.known.items():
        path = store.find(known.file)
        facts.append(
            {
                "name": name,
                "needed_by": list(known.needed_by),
                "distribution": known.distribution,
                "present": path is not None,
                "path": str(path) if path else "",
                "size": path.stat().st_size if path else known.file.size,
                "licence": known.file.licence,
                "published_file": known.file.file,
                "published_sha256": known.file.sha256,
                "urls": list(known.file.urls),
                "reference": known.file.reference,
                "recorded": records.get(name, {}),
            }
        )
    return as_json({"folder": str(store.folder), "weights": facts})


def _fetch(store: WeightsStore, args: argparse.Namespace) -> int:
    from droidw.cli.transfer import Bar

    names = list(store.known) if args.all else [store.file(name).name for name in args.names]
    if not names:
        raise UsageError(
            "no NAME is given to fetch",
            f"names: {', '.join(store.known)}\nor everything: droidw weights fetch --all",
        )
    for name in names:
        bar = Bar(name, quiet=args.quiet)
        try:
            path, came = store.fetch(name, force=args.force, offline=args.offline, progress=bar)
        finally:
            bar.close()
        licence = store.known[name].file.licence
        print(f"{name}: {'stored as' if came else 'is there and verified:'} {path}")
        if came:
            print(f"  licence: {licence}")
    return 0


def _add(store: WeightsStore, files: list[str], name: str) -> int:
    if not files:
        raise UsageError("no FILE is given to add", "type: droidw weights add FILE")
    if name and len(files) > 1:
        raise UsageError("--name says what one file is, and several are given", "add one at a time")
    for given in files:
        file, path = store.add(Path(given).expanduser(), name)
        print(f"{given} is '{file.name}' and fits; stored as {path}")
    return 0


def _verify(store: WeightsStore, names: list[str]) -> int:
    wanted = [store.file(name).name for name in names]
    if not wanted:
        wanted = [name for name, known in store.known.items() if store.find(known.file)]
        if not wanted:
            print(f"no weights are in {store.folder}")
            return 0
    worst = 0
    for name in wanted:
        there = store.find(store.file(name)) is not None
        try:
            print(f"{name}: ok: {store.verify(name)}")
        except DroidwError as error:
            print(f"{name}: {'BAD' if there else 'MISSING'}: {error}")
            worst = max(worst, error.exit_code)
    return worst
