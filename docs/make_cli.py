"""Fill the option tables of docs/cli.md from the parsers of the commands.

    python docs/make_cli.py            # rewrite docs/cli.md
    python docs/make_cli.py --check    # exit 1 if it is out of date

Between `<!-- options: VERB -->` and `<!-- end -->` everything is made here; the rest is prose.
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from pathlib import Path

from droidw.cli.main import VERBS, build_parser

PAGE = Path(__file__).resolve().parent / "cli.md"
MARKED = re.compile(r"(<!-- options: ([a-z-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def table(verb: str) -> str:
    """Arguments of one command as a Markdown table."""
    rows = ["| argument | meaning |", "|---|---|"]
    parser = build_parser(verb, importlib.import_module(VERBS[verb]))
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        rows.append(f"| {_names(action)} | {_cell(action.help or '')} |")
    return "\n".join(rows) + "\n"


def filled(text: str) -> str:
    """The page with its tables made anew."""
    return MARKED.sub(lambda found: found[1] + table(found[2]) + found[3], text)


def _names(action: argparse.Action) -> str:
    value = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    )
    if not action.option_strings:
        return f"`{_cell(str(value))}`"
    takes = "" if action.nargs == 0 else f" {value}"
    return ", ".join(f"`{_cell(name + takes)}`" for name in action.option_strings)


def _cell(text: str) -> str:
    return text.replace("|", r"\|")


if __name__ == "__main__":
    before = PAGE.read_text(encoding="utf-8")
    after = filled(before)
    if "--check" in sys.argv[1:]:
        sys.exit(0 if before == after else f"{PAGE} is out of date: python docs/make_cli.py")
    PAGE.write_text(after, encoding="utf-8")
