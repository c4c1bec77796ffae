"""`droidw ablate`: rows x sequences x seeds, and the table of them."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from droidw.cli.options import add_plugin_arguments, plugins_from
from droidw.errors import Interrupted, UsageError

if TYPE_CHECKING:
    from droidw.ablation.table import Table

__all__ = ["HELP", "add_arguments", "main"]

HELP = "run an ablation, rows x sequences x seeds, and make its table"
USAGE = "%(prog)s ABLATION [options] [key=value ...]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `droidw ablate`."""
    parser.add_argument(
        "items",
        metavar="ABLATION [key=value ...]",
        nargs="+",
        help="a YAML file, or one that comes with droidw by its name; then configuration "
        "overrides for all cells, which win over the file but for its rows",
    )
    parser.add_argument(
        "-o", "--output", metavar="DIR", help="folder for cells and table (runs/ablations/NAME)"
    )
    parser.add_argument(
        "--data",
        metavar="DIR",
        help="folder that holds the sequences, and the datasets that are known by name",
    )
    parser.add_argument(
        "--sequences",
        metavar="A,B",
        help="these sequences instead of those of the file: folders in --data, or sources",
    )
    parser.add_argument("--rows", metavar="A,B", help="only these rows of the file")
    parser.add_argument("--seeds", metavar="0,1", help="these seeds instead of those of the file")
    parser.add_argument(
        "--preset",
        help="cpu, quick, paper, droid-slam or auto, instead of what the file says (default: auto)",
    )
    parser.add_argument(
        "--jobs", metavar="N", type=int, default=1, help="cells at a time (default: 1)"
    )
    parser.add_argument(
        "--executor",
        choices=("local", "ray"),
        default="local",
        help="local: processes of this machine; ray: tasks of Ray (needs droidw[ray])",
    )
    parser.add_argument(
        "--ray-address",
        metavar="A",
        help="a Ray cluster that runs already, or auto for that of this machine "
        "(default: one of our own)",
    )
    parser.add_argument(
        "--limit", metavar="S", type=float, help="seconds after which a cell counts as failed"
    )
    parser.add_argument("--again", action="store_true", help="run finished cells again too")
    parser.add_argument("--json", action="store_true", help="print the table as JSON")
    add_plugin_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Run what has no result yet; the code is 0 if every cell has one, else that of the first.

    Raises:
        DroidwError: as `load_plan`, `make_cells` and `run_ablation`.
        Interrupted: a signal came; finished cells stay, and the next call goes on.
    """
    from droidw.ablation.cells import make_cells
    from droidw.ablation.plan import load_plan
    from droidw.ablation.run import Means, run_ablation
    from droidw.cli.live import Live
    from droidw.run.signals import Stop

    file, overrides = _split(args.items)
    if args.jobs < 1:
        raise UsageError(f"--jobs counts from 1, and {args.jobs} is less")
    if args.limit is not None and not 0 < args.limit < math.inf:
        raise UsageError(f"--limit is a number of seconds above 0, and not {args.limit}")
    if args.ray_address and args.executor != "ray":
        raise UsageError("--ray-address is for --executor ray")
    plan = load_plan(
        file,
        Path(args.data) if args.data else None,
        _names(args.sequences),
        _names(args.rows),
        _numbers(args.seeds),
    )
    data = Path(args.data) if args.data else None
    cells, note = make_cells(
        plan, plugins_from(args), overrides, args.preset, plugin_files=args.plugin, data=data
    )
    folder = Path(args.output) if args.output else Path("runs/ablations") / Path(file).stem
    means = Means(
        args.executor,
        args.jobs,
        args.limit,
        args.ray_address,
        tuple(args.plugin),
        data,
        args.again,
    )
    command = shlex.join(["droidw", "ablate", *_told(args, file, overrides)])
    with Stop() as stop, Live(plan, cells, sys.stderr, quiet=args.quiet) as live:
        if note:
            live.say(note)
        table = run_ablation(
            plan, cells, folder, means, live.tell, lambda: stop.signum > 0, command
        )
    _show(table, folder, args)
    if stop.signum:
        raise Interrupted(
            "the ablation was stopped by a signal",
            stop.signum,
            f"finished cells stay in {folder}; the same command"
            f"{', without --again,' if args.again else ''} goes on with the others",
        )
    return _code(table)


def _show(table: Table, folder: Path, args: argparse.Namespace) -> None:
    from droidw.ablation.files import FILES
    from droidw.cli.render import as_json
    from droidw.cli.render import table as text

    if args.json:
        print(as_json(table.to_dict()))
        return
    for column in table.columns:
        print(f"{table.title(column)}\n{text(table.grid(column), indent=2)}\n")
    failures = table.failures()
    if failures:
        print("without a result:")
        print(text([(cell.name, why) for cell, why in failures], indent=2) + "\n")
    remarks = table.remarks()
    if remarks:
        print("to be known:")
        print(text(remarks, indent=2) + "\n")
    width = max(len(name) for name in FILES)
    for name, meaning in FILES.items():
        print(f"  {folder}/{name:<{width}}  {meaning}")


def _code(table: Table) -> int:
    for cell, outcome in table.cells:
        if not cell.missing and (outcome is None or outcome.error):
            return 1 if outcome is None else outcome.code
    return 0


def _split(items: list[str]) -> tuple[str, list[str]]:
    file, *rest = items
    for item in rest:
        if "=" not in item:
            raise UsageError(
                f"'{item}' is neither an option nor an override",
                "one ABLATION comes first, then key=value; options start with --",
            )
    return file, rest


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip()) if text else ()


def _numbers(text: str | None) -> tuple[int, ...]:
    try:
        numbers = tuple(int(part) for part in _names(text))
    except ValueError as error:
        raise UsageError(
            f"--seeds: '{text}' is no list of whole numbers", "for example: --seeds 0,1,2"
        ) from error
    if any(number < 0 for number in numbers):
        raise UsageError(f"--seeds: '{text}' holds a number below 0")
    return numbers


def _told(args: argparse.Namespace, file: str, overrides: list[str]) -> list[str]:
    """What of the command line decides the table, for whoever wants to make it again."""
    words = [file, *overrides]
    for flag in ("data", "sequences", "rows", "seeds", "preset"):
        if getattr(args, flag):
            words += [f"--{flag}", getattr(args, flag)]
    for plugin in args.plugin:
        words += ["--plugin", plugin]
    return words
