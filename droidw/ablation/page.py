"""The page of an ablation: tables, bars, errors over time and paths, in one file."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from droidw.ablation.cells import Outcome
from droidw.ablation.table import NOT_RUN, Column, Table
from droidw.eval.svg import Bars, Line, bar_chart, colour, line_chart, path_panels

__all__ = ["make_page"]

_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#222;max-width:1020px;margin:2em auto;padding:0 1em}
h1{margin-bottom:.2em}h2{margin-top:2em;border-bottom:1px solid #ddd}
table{border-collapse:collapse;margin:.8em 0;display:block;overflow-x:auto}
th,td{padding:.25em .8em;text-align:right;white-space:nowrap;border-bottom:1px solid #e5e5e5}
th:first-child,td:first-child{text-align:left}td.best{font-weight:700}td.bad{color:#b00020}
pre{background:#f6f6f6;padding:.6em;overflow-x:auto}svg{max-width:100%;height:auto}
.why{color:#b00020}details{margin:.5em 0}footer{color:#777;margin-top:3em}
"""


def make_page(table: Table, command: str = "") -> str:
    """The page as text: no scripts, nothing loaded from anywhere."""
    plan = table.plan
    done = sum(outcome is not None and not outcome.error for _, outcome in table.cells)
    parts = [
        f"<h1>{escape(plan.title)}</h1><p>Rows: {len(plan.rows)}, sequences: "
        f"{len(plan.sequences)}, seeds: {len(plan.seeds)}. {done} of {len(table.cells)} cells have "
        "a result.</p>"
    ]
    if command:
        parts.append(f"<pre>{escape(command)}</pre>")
    for column in table.columns:
        parts.append(f"<h2>{escape(table.title(column))}</h2>{_table(table, column)}")
        parts.append(_bars(table, column))
    failures = [(cell.name, why) for cell, why in table.failures()]
    parts.append(_listed("Without a result", failures, "why"))
    parts.append(_listed("To be known", table.remarks()))
    parts += [_sequence(table, sequence) for sequence in plan.sequences]
    parts.append(_cells(table))
    body = "\n".join(part for part in parts if part)
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        f"<meta name='viewport' content='width=device-width'><title>{escape(plan.title)}</title>"
        f"<style>{_STYLE}</style></head><body>{body}"
        "<footer>Made by droidw ablate. This page needs no network.</footer></body></html>\n"
    )


def _table(table: Table, column: Column) -> str:
    head, *rows = table.grid(column)
    best = _best(table, column)
    lines = ["<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>"]
    for row in rows:
        cells = [f"<td>{escape(row[0])}</td>"]
        for name, cell in zip(head[1:], row[1:], strict=True):
            css = " class='best'" if best.get(name) == row[0] else ""
            css = " class='bad'" if cell in ("failed", NOT_RUN) else css
            cells.append(f"<td{css}>{escape(cell)}</td>")
        lines.append("<tr>" + "".join(cells) + "</tr>")
    return f"<table>{''.join(lines)}</table>"


def _best(table: Table, column: Column) -> dict[str, str]:
    """Sequence -> the row with the best mean."""
    found: dict[str, str] = {}
    if column.lower is None:
        return found
    for sequence in table.having(column.key):
        means = {row: table.entry(column.key, row, sequence).mean for row in table.plan.rows}
        known = {row: mean for row, mean in means.items() if mean is not None}
        choose = min if column.lower else max
        if len(known) > 1:
            found[sequence] = choose(known, key=known.__getitem__)
    return found


def _bars(table: Table, column: Column) -> str:
    sequences = table.having(column.key)
    if not sequences:
        return ""
    bars = []
    for row in table.plan.rows:
        entries = [table.entry(column.key, row, sequence) for sequence in sequences]
        bars.append(
            Bars(
                row,
                [entry.mean for entry in entries],
                [entry.spread for entry in entries],
                [entry.values for entry in entries],
            )
        )
    return bar_chart("", sequences, bars, table.title(column))


def _curves(table: Table, sequence: str) -> list[tuple[str, Outcome]]:
    """The first seed of each row that has a path to draw."""
    found: dict[str, Outcome] = {}
    for cell, outcome in table.cells:
        if cell.sequence == sequence and outcome is not None and outcome.curve:
            found.setdefault(cell.row, outcome)
    return list(found.items())


def _sequence(table: Table, sequence: str) -> str:
    curves = _curves(table, sequence)
    if not curves:
        return ""
    unit = str(curves[0][1].curve["unit"])
    names = list(table.plan.rows)
    lines, paths = [], []
    truth = np.asarray(curves[0][1].curve["truth"], dtype=np.float64)
    paths.append(("reference", truth, "#999999", True))
    for row, outcome in curves:
        curve, stroke = outcome.curve, colour(names.index(row))
        x, y = (np.asarray(curve[key], dtype=np.float64) for key in ("times", "errors"))
        lines.append(Line(row, x, y, stroke))
        paths.append((row, np.asarray(curve["path"], dtype=np.float64), stroke, False))
    size = (1000, 320)
    errors = line_chart("Position error", lines, "time [s]", f"error [{unit}]", size)
    views = path_panels("Paths", paths, unit)
    return f"<h2>{escape(sequence)}</h2><p>First seed of each row.</p>{errors}{views}"


def _listed(title: str, sentences: Sequence[tuple[str, str]], style: str = "") -> str:
    items = [
        f"<li><code>{escape(name)}</code>: <span class='{style}'>{escape(sentence)}</span></li>"
        for name, sentence in sentences
    ]
    return f"<h2>{title}</h2><ul>{''.join(items)}</ul>" if items else ""


def _cells(table: Table) -> str:
    rows = ["<tr><th>cell</th><th>device</th><th>droidw</th><th>seconds</th><th>folder</th></tr>"]
    for cell, outcome in table.cells:
        facts = {} if outcome is None else outcome.facts
        versions = facts.get("versions", {})
        seconds = f"{outcome.seconds:.1f}" if outcome is not None else ""
        link = f"cells/{cell.name}/run/manifest.json"
        rows.append(
            f"<tr><td>{escape(cell.name)}</td><td>{escape(str(versions.get('device', '')))}</td>"
            f"<td>{escape(str(versions.get('droidw', '')))}</td><td>{seconds}</td>"
            f"<td><a href='{escape(link, quote=True)}'>manifest</a></td></tr>"
        )
    return f"<h2>Cells</h2><details><summary>all</summary><table>{''.join(rows)}</table></details>"
