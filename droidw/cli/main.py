"""The `droidw` command: finds the verb, and turns errors into sentences and exit codes.

A verb is a module with `HELP`, `add_arguments(parser)` and `main(args) -> int`. Only the module
of the verb that was typed is imported; importing it, and building its parser, loads no torch.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Mapping, Sequence
from types import ModuleType

from droidw.errors import DroidwError, UsageError, did_you_mean

__all__ = ["VERBS", "build_parser", "main"]

VERBS: Mapping[str, str] = {
    "run": "droidw.cli.run",
    "eval": "droidw.cli.evaluate",
    "ablate": "droidw.cli.ablate",
    "list-plugins": "droidw.cli.list_plugins",
    "demo": "droidw.cli.demo",
    "weights": "droidw.cli.weights",
    "data": "droidw.cli.data",
    "doctor": "droidw.cli.doctor",
}
"""Verb -> the module that holds it, in the order of the help text."""

_DESCRIPTION = (
    "Camera poses, dense depth, dynamic uncertainty and a static point cloud from a monocular "
    "video in which things move."
)
_EXIT_CODES = (
    "exit codes: 0 done, 1 a bug, 2 usage or configuration, 3 input, 4 tracking failed, "
    "5 a missing plugin, extra or weights file, 130 or 143 interrupted"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: arguments without the program's name; those of the process if None.
    Returns:
        The exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
        return code
    except SystemExit as stop:  # argparse: help, version, usage
        return stop.code if isinstance(stop.code, int) else 1
    except DroidwError as error:
        print(f"droidw: error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("droidw: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # whoever read our output has gone; stop Python from complaining when it flushes at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + 13
    except Exception as error:  # noqa: BLE001 - the last resort of a program
        traceback.print_exc()
        print(
            f"\ndroidw: error: {type(error).__name__}: {error}\n"
            "  this is a bug of droidw or of a plugin, not a mistake of yours; please report it\n"
            f"  with the lines above, the command ({_quoted(arguments)})\n"
            "  and the output of: droidw doctor",
            file=sys.stderr,
        )
        return 1


def build_parser(verb: str, module: ModuleType) -> argparse.ArgumentParser:
    """The parser of one verb, as `droidw VERB -h` shows it."""
    parser = argparse.ArgumentParser(
        prog=f"droidw {verb}",
        usage=getattr(module, "USAGE", None),
        description=module.HELP[:1].upper() + module.HELP[1:] + ".",
    )
    module.add_arguments(parser)
    _add_verbosity(parser)
    return parser


def _dispatch(arguments: list[str]) -> int:
    top = _top_parser()
    before = _verb_position(arguments)
    general = top.parse_args(arguments[:before])
    if before == len(arguments):
        print(_help(top))
        return 0 if general.help else 2
    verb, rest = arguments[before], arguments[before + 1 :]
    if verb not in VERBS:
        raise UsageError(
            f"there is no command '{verb}'",
            did_you_mean(verb, VERBS) + f"commands: {', '.join(VERBS)}",
        )
    if general.help:
        rest.append("--help")
    module = importlib.import_module(VERBS[verb])
    args = build_parser(verb, module).parse_intermixed_args(rest)
    args.verbose += general.verbose
    args.quiet = args.quiet or general.quiet

    from droidw.log import set_up

    set_up(-1 if args.quiet else args.verbose)
    return int(module.main(args))


def _verb_position(arguments: Sequence[str]) -> int:
    """Index of the first argument that is no option; no general option takes a value."""
    return next((k for k, text in enumerate(arguments) if not text.startswith("-")), len(arguments))


def _top_parser() -> argparse.ArgumentParser:
    from droidw import __version__

    parser = argparse.ArgumentParser(prog="droidw", add_help=False, description=_DESCRIPTION)
    parser.add_argument("-h", "--help", action="store_true", help="show this text")
    parser.add_argument("--version", action="version", version=f"droidw {__version__}")
    _add_verbosity(parser)
    return parser


def _add_verbosity(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("messages")
    group.add_argument("-v", "--verbose", action="count", default=0, help="say more; twice: all")
    group.add_argument("-q", "--quiet", action="store_true", help="say only what went wrong")


def _help(top: argparse.ArgumentParser) -> str:
    from droidw.cli.render import paragraph, table

    rows = [(verb, importlib.import_module(name).HELP) for verb, name in VERBS.items()]
    options = top.format_help().partition("options:")[2].strip("\n")
    return "\n".join(
        [
            "usage: droidw COMMAND ...      droidw COMMAND -h explains one",
            "",
            paragraph(_DESCRIPTION),
            "",
            "commands:",
            table(rows, indent=2),
            "",
            "options:",
            options,
            "",
            paragraph(_EXIT_CODES, indent=2),
        ]
    )


def _quoted(arguments: Sequence[str]) -> str:
    import shlex

    return shlex.join(["droidw", *arguments])
