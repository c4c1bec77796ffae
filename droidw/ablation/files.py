"""The table as Markdown, CSV, JSON and a page."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from droidw.ablation.page import make_page
from droidw.ablation.table import Table
from droidw.io.files import write_json, write_text

__all__ = ["FILES", "comma_separated", "markdown", "write_files"]

FILES = {
    "table.md": "the table as Markdown",
    "cells.csv": "every figure of every cell",
    "table.json": "the same with means and spreads",
    "report.html": "tables and plots on one page that needs no network",
}
"""What `write_files` writes, and what it is."""


def write_files(table: Table, folder: Path, command: str = "") -> list[Path]:
    """Write all forms of a table.

    Args:
        table: what to write. folder: where.
        command: how it was made, for the page and Markdown.
    Raises:
        UsageError: the folder cannot be written to.
    """
    texts = {
        "table.md": markdown(table, command),
        "cells.csv": comma_separated(table),
        "report.html": make_page(table, command),
    }
    for name, content in texts.items():
        write_text(folder / name, content)
    write_json(folder / "table.json", table.to_dict())
    return [folder / name for name in FILES]


def markdown(table: Table, command: str = "") -> str:
    """The shown figures as tables, with mean and spread over the seeds, and what failed."""
    plan = table.plan
    seeds = ", ".join(str(seed) for seed in plan.seeds)
    lines = [f"# {plan.title}", ""]
    if command:
        lines += [f"    {command}", ""]
    lines.append(
        f"Seeds {seeds}"
        + ("; mean ± standard deviation over them" if len(plan.seeds) > 1 else "")
        + f". Alignment {plan.measure.align}. `x` is the geometric mean over the sequences of a "
        "row's figure by the first row's."
    )
    for column in table.columns:
        better = {True: " (less is better)", False: " (more is better)", None: ""}[column.lower]
        head, *rows = table.grid(column)
        lines += ["", f"## {table.title(column)}{better}", ""]
        lines += [_row(head), _row(["---"] + ["---:"] * (len(head) - 1))]
        lines += [_row(row) for row in rows]
    failures = table.failures()
    if failures:
        lines += ["", "## Without a result", ""]
        lines += [f"- `{cell.name}`: {why}" for cell, why in failures]
    remarks = table.remarks()
    if remarks:
        lines += ["", "## To be known", ""]
        lines += [f"- `{name}`: {sentence}" for name, sentence in remarks]
    return "\n".join(lines) + "\n"


def comma_separated(table: Table) -> str:
    """One line per cell: row, sequence, seed, error, then every figure that any cell has."""
    keys = sorted({key for _, o in table.cells if o is not None for key in o.metrics})
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["row", "sequence", "seed", "error", *keys])
    for cell, outcome in table.cells:
        error = cell.missing or ("not run" if outcome is None else outcome.error)
        metrics = {} if outcome is None else outcome.metrics
        figures = [repr(metrics[key]) if key in metrics else "" for key in keys]
        writer.writerow([cell.row, cell.sequence, cell.seed, error, *figures])
    return out.getvalue()


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
