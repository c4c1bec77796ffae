"""From cells to a table: means, spreads and ratios."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from droidw.ablation.cells import Cell, Outcome
from droidw.ablation.plan import Plan

__all__ = ["COLUMNS", "NOT_RUN", "Column", "Entry", "Table", "make_table"]


# Of an error that is shown, and after the point.
_SIGNIFICANT, _MOST_DIGITS = 3, 8
NOT_RUN = "not run"


@dataclass(frozen=True)
class Column:
    """A figure that tables show.

    Attributes:
        key: its dotted name. label: its title. digits: after the point.
        lower: whether less is better; None where neither is.
    """

    key: str
    label: str
    digits: int = 4
    lower: bool | None = True


COLUMNS: Mapping[str, Column] = {
    column.key: column
    for column in (
        Column("ate_rmse", "ATE rmse, all frames"),
        Column("keyframes.ate_rmse", "ATE rmse, keyframes"),
        Column("ate_percent", "ATE rmse, % of the path", 2),
        Column("rpe_trans_rmse", "RPE rmse, translation"),
        Column("rpe_rot_deg_rmse", "RPE rmse, degrees", 3),
        Column("masks.auc", "motion masks, AUC", 3, False),
        Column("masks.f1", "motion masks, best F1", 3, False),
        Column("masks.iou", "motion masks, best IoU", 3, False),
        Column("fps", "frames per second", 1, False),
        Column("seconds", "seconds", 1),
        Column("peak_memory_mb", "peak memory, MB", 0),
        Column("keyframe_count", "keyframes", 0, None),
    )
}
"""Figures with a title of their own; any other key of `droidw eval --json` works too."""


@dataclass(frozen=True)
class Entry:
    """One row on one sequence over all seeds.

    Attributes:
        values: of the seeds that have one. wanted: how many seeds there are.
        mean: of the values, or None. spread: their sample standard deviation, None below two.
        errors: why seeds have none.
    """

    values: tuple[float, ...]
    wanted: int
    errors: tuple[str, ...] = ()

    @property
    def mean(self) -> float | None:
        """Mean over the seeds that have a value."""
        return statistics.fmean(self.values) if self.values else None

    @property
    def spread(self) -> float | None:
        """Sample standard deviation over the seeds."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None


@dataclass(frozen=True)
class Table:
    """All figures of an ablation.

    Attributes:
        plan: what was asked. unit: of lengths.
        columns: figures shown.
        cells: every cell with what came of it; None where it has not run.
    """

    plan: Plan
    unit: str
    columns: tuple[Column, ...]
    cells: tuple[tuple[Cell, Outcome | None], ...]

    def entry(self, column: str, row: str, sequence: str) -> Entry:
        """A figure of one row on one sequence."""
        mine = [(c, o) for c, o in self.cells if (c.row, c.sequence) == (row, sequence)]
        values = [o.metrics[column] for _, o in mine if o is not None and column in o.metrics]
        errors = [
            (o.error if o is not None else "") or c.missing or NOT_RUN
            for c, o in mine
            if o is None or o.error
        ]
        return Entry(tuple(values), len(mine), tuple(errors))

    def average(self, column: str, row: str) -> float | None:
        """Mean over the sequences, where all of them have a value."""
        means = [self.entry(column, row, sequence).mean for sequence in self.having(column)]
        known = [mean for mean in means if mean is not None]
        return statistics.fmean(known) if known and len(known) == len(means) else None

    def ratio(self, column: str, row: str) -> float | None:
        """Geometric mean over the sequences of this row's value by the first row's."""
        first = next(iter(self.plan.rows))
        logs = []
        for sequence in self.having(column):
            mine = self.entry(column, row, sequence).mean
            theirs = self.entry(column, first, sequence).mean
            if not mine or not theirs or mine < 0 or theirs < 0:
                return None
            logs.append(math.log(mine / theirs))
        return math.exp(statistics.fmean(logs)) if logs else None

    def having(self, column: str) -> tuple[str, ...]:
        """Sequences on which any row has this figure."""
        return tuple(
            sequence
            for sequence in self.plan.sequences
            if any(self.entry(column, row, sequence).values for row in self.plan.rows)
        )

    def failures(self) -> list[tuple[Cell, str]]:
        """Cells that have no figures, and why."""
        found = []
        for cell, outcome in self.cells:
            why = cell.missing or (NOT_RUN if outcome is None else outcome.error)
            if why:
                found.append((cell, why))
        return found

    def remarks(self) -> list[tuple[str, str]]:
        """What is to be known of figures: (column, sequence or cell, a sentence), in this order.

        Columns that no cell has, sequences of which no cell has a result, in what else than their
        configuration cells with a result differ, and what their runs were warned of and measuring
        noted.
        """
        shown = {column.key for column in self.columns}
        found = [(key, "no cell has this figure") for key in self.plan.columns if key not in shown]
        known = {cell.sequence for cell, outcome in self.cells if outcome and not outcome.error}
        found += [
            (name, "no cell has a result: it is not in the tables, nor in their means")
            for name in self.plan.sequences
            if known and name not in known
        ]
        found += [
            ("cells", f"they differ in what made them, {key}: {', '.join(values)}")
            for key, values in self._made_with()
            if len(values) > 1
        ]
        for cell, outcome in self.cells:
            if outcome is None or outcome.error:
                continue
            said = [*outcome.facts.get("warnings", ()), *outcome.facts.get("notes", ())]
            found += [(cell.name, str(sentence)) for sentence in dict.fromkeys(said)]
        return found

    def _made_with(self) -> list[tuple[str, list[str]]]:
        """Versions of packages and machines, and those that cells have: kept cells may be old."""
        made: dict[str, list[str]] = {}
        for _, outcome in self.cells:
            if outcome is None or outcome.error:
                continue
            for key, value in dict(outcome.facts.get("versions", {})).items():
                known = made.setdefault(str(key), [])
                if str(value) not in known:
                    known.append(str(value))
        return list(made.items())

    def grid(self, column: Column) -> list[list[str]]:
        """Rows of text: a head, then each row with every sequence, the mean and the ratio."""
        sequences = self.having(column.key)
        several = len(sequences) > 1
        head = ["", *sequences, *(["mean"] if several else []), f"x {next(iter(self.plan.rows))}"]
        lines = [head]
        for row in self.plan.rows:
            line = [row] + [text(self.entry(column.key, row, s), column) for s in sequences]
            average, ratio = self.average(column.key, row), self.ratio(column.key, row)
            if several:
                line.append("-" if average is None else f"{average:.{column.digits}f}")
            line.append("-" if ratio is None else f"{ratio:.2f}")
            lines.append(line)
        return lines

    def title(self, column: Column) -> str:
        """Title of a column with its unit."""
        lengths = ("ate_", "keyframes.ate_", "rpe_trans_", "keyframes.rpe_trans_")
        metric = column.key.startswith(lengths) and "percent" not in column.key
        return column.label + (f" [{self.unit}]" if metric else "")

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: every cell, and every entry of every figure."""
        keys = sorted({key for _, o in self.cells if o is not None for key in o.metrics})
        return {
            "title": self.plan.title,
            "file": self.plan.file,
            "rows": list(self.plan.rows),
            "sequences": list(self.plan.sequences),
            "seeds": list(self.plan.seeds),
            "unit": self.unit,
            "columns": [column.key for column in self.columns],
            "measure": dict(self.plan.measure.__dict__),
            "figures": {
                key: {
                    row: {
                        sequence: {"mean": e.mean, "spread": e.spread, "values": list(e.values)}
                        for sequence in self.plan.sequences
                        for e in [self.entry(key, row, sequence)]
                    }
                    for row in self.plan.rows
                }
                for key in keys
            },
            "cells": [
                {
                    "row": cell.row,
                    "sequence": cell.sequence,
                    "seed": cell.seed,
                    "folder": f"cells/{cell.name}",
                    "digest": cell.digest,
                    "error": cell.missing or (NOT_RUN if outcome is None else outcome.error),
                    "metrics": {} if outcome is None else dict(outcome.metrics),
                    "facts": {} if outcome is None else dict(outcome.facts),
                }
                for cell, outcome in self.cells
            ],
        }


def text(entry: Entry, column: Column) -> str:
    """An entry for a table: mean, spread, and how many seeds where some have none."""
    if entry.mean is None:
        if set(entry.errors) == {NOT_RUN}:
            return NOT_RUN
        return "failed" if entry.errors else "-"
    said = f"{entry.mean:.{column.digits}f}"
    if entry.spread is not None:
        said += f" ± {entry.spread:.{column.digits}f}"
    if len(entry.values) < entry.wanted:
        said += f" ({len(entry.values)} of {entry.wanted})"
    return said


def make_table(plan: Plan, cells: Sequence[tuple[Cell, Outcome | None]]) -> Table:
    """The table of cells and what came of them; columns that no cell has are left out."""
    units = {str(o.facts.get("unit", "m")) for _, o in cells if o is not None and o.facts}
    have = {key for _, o in cells if o is not None for key in o.metrics}
    columns = tuple(
        _fine(COLUMNS.get(key, Column(key, key, lower=None)), cells)
        for key in plan.columns
        if key in have
    )
    return Table(plan, " or ".join(sorted(units)) or "m", columns, tuple(cells))


def _fine(column: Column, cells: Sequence[tuple[Cell, Outcome | None]]) -> Column:
    """The column with as many digits as its least error needs, if it is one of errors."""
    if column.digits != Column.digits:
        return column
    values = [o.metrics.get(column.key, 0.0) for _, o in cells if o is not None]
    least = min((value for value in values if value > 0), default=1.0)
    digits = _SIGNIFICANT - 1 - math.floor(math.log10(least))
    return replace(column, digits=min(max(column.digits, digits), _MOST_DIGITS))
