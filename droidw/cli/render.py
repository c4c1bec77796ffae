"""Tables and JSON, shared by the verbs."""

from __future__ import annotations

import json
import shutil
import textwrap
from collections.abc import Sequence
from typing import Any

__all__ = ["as_json", "paragraph", "table", "terminal_width"]


def table(rows: Sequence[Sequence[str]], indent: int = 0, gap: int = 2, width: int = 0) -> str:
    """Columns aligned left, each as wide as its widest cell.

    Args:
        rows: cells; all rows have the same number.
        indent: spaces in front of each row.
        gap: spaces between columns.
        width: the last column but one is shortened so that rows fit (0: never).
    """
    if not rows:
        return ""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    if width and len(widths) > 1:
        excess = indent + sum(widths) + gap * (len(widths) - 1) - width
        if excess > 0:
            widths[-2] = max(widths[-2] - excess, 20)
    lines = []
    for row in rows:
        cells = [_shorten(cell, size).ljust(size) for cell, size in zip(row, widths, strict=True)]
        lines.append((" " * indent + (" " * gap).join(cells)).rstrip())
    return "\n".join(lines)


def as_json(value: Any) -> str:
    """Indented JSON, keys in the order given."""
    return json.dumps(value, indent=2, ensure_ascii=False)


def paragraph(text: str, indent: int = 0, width: int = 0) -> str:
    """Text broken into lines, the later ones indented."""
    return textwrap.fill(
        text, width or terminal_width(), subsequent_indent=" " * indent, break_on_hyphens=False
    )


def terminal_width(default: int = 100) -> int:
    """Columns of the terminal, or `default` where there is none."""
    return shutil.get_terminal_size((default, 24)).columns


def _shorten(text: str, size: int) -> str:
    return text if len(text) <= size else text[: size - 3].rstrip() + "..."
