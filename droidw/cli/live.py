"""The table of an ablation while it runs: redrawn on a terminal, a line per cell elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

from droidw.cli.render import table

if TYPE_CHECKING:
    from droidw.ablation.cells import Cell, Outcome
    from droidw.ablation.plan import Plan

__all__ = ["Live"]

_KEYS = ("ate_rmse", "masks.auc", "fps")
"""The first of these that a cell has stands for it."""


class Live:
    """Hears of cells, and shows rows x sequences.

    Args:
        plan, cells: of the ablation.
        stream: where it is shown. quiet: show nothing.
    """

    def __init__(
        self, plan: Plan, cells: Sequence[Cell], stream: TextIO, quiet: bool = False
    ) -> None:
        self._plan, self._stream, self._quiet = plan, stream, quiet
        self._drawn = 0
        self._redraws = stream.isatty() and not quiet
        self._states: dict[str, str] = {cell.name: "waiting" for cell in cells}
        self._figures: dict[str, tuple[str, float]] = {}
        self._cells = list(cells)
        self._began = time.monotonic()

    def __enter__(self) -> Live:
        if self._redraws:
            self._draw()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stream.flush()

    def say(self, text: str) -> None:
        """A line above the table."""
        if self._quiet:
            return
        self._wipe()
        self._stream.write(text + "\n")
        if self._redraws:
            self._draw()
        self._stream.flush()

    def tell(self, cell: Cell, state: str, outcome: Outcome | None) -> None:
        """Show what became of a cell."""
        self._states[cell.name] = state
        if outcome is not None:
            for key in _KEYS:
                if key in outcome.metrics:
                    self._figures[cell.name] = (key, outcome.metrics[key])
                    break
        if self._redraws:
            if state == "failed" and outcome is not None:
                self.say(f"{cell.name}: {outcome.error}")
            else:
                self._wipe()
                self._draw()
        elif not self._quiet and state != "running":
            self._line(cell, state, outcome)
        self._stream.flush()

    def _line(self, cell: Cell, state: str, outcome: Outcome | None) -> None:
        over = sum(s in ("done", "failed", "kept", "missing") for s in self._states.values())
        text = f"[{over}/{len(self._cells)}] {cell.name}: {state}"
        if state == "missing":
            text += f": {cell.missing}"
        if outcome is not None:
            if outcome.error:
                text += f": {outcome.error}"
            elif cell.name in self._figures:
                key, value = self._figures[cell.name]
                text += f" in {outcome.seconds:.1f} s, {key} {value:.4g}"
        self._stream.write(text + "\n")

    def _draw(self) -> None:
        rows = [["", *self._plan.sequences]]
        for row in self._plan.rows:
            rows.append([row, *(self._state(row, seq) for seq in self._plan.sequences)])
        states = list(self._states.values())
        counts = {word: states.count(word) for word in dict.fromkeys(states)}
        told = ", ".join(f"{count} {word}" for word, count in counts.items())
        text = f"{table(rows, indent=2)}\n  {told}; {time.monotonic() - self._began:.0f} s\n"
        self._stream.write(text)
        self._drawn = text.count("\n")

    def _state(self, row: str, sequence: str) -> str:
        """Seeds of one place of the table: their mean so far, and what the others do."""
        mine = [c.name for c in self._cells if (c.row, c.sequence) == (row, sequence)]
        values = [self._figures[name][1] for name in mine if name in self._figures]
        states = [self._states[name] for name in mine]
        parts = []
        if values:
            parts.append(f"{sum(values) / len(values):.4g}")
        for word in ("failed", "missing", "running", "waiting"):
            count = states.count(word)
            if count:
                parts.append(word if len(mine) == 1 else f"{count} {word}")
        return " ".join(parts) or "-"

    def _wipe(self) -> None:
        """Take the table off the terminal, to be drawn again."""
        if self._drawn:
            self._stream.write(f"\x1b[{self._drawn}F\x1b[J")
            self._drawn = 0
