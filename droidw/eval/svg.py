"""Small charts as SVG: text that every browser draws, written without a plotting package.

A plotting package would be the largest thing that droidw installs for four pictures, and its files
are not the same bytes twice. What is needed here is lines, bars, ticks and a legend.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
import numpy.typing as npt

__all__ = ["Bars", "Line", "bar_chart", "colour", "document", "line_chart", "path_panels"]

Array = npt.NDArray[np.float64]

_PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f3c8d", "#666666")
"""Told apart by colour-blind readers too."""

_DARKER = 0.6  # share that is left of a colour where all of them are taken

_MARGIN = 76.0  # left of a chart: its label, and numbers as long as -0.0004
_GREY, _INK = "#dddddd", "#333333"
_FONT = "font-family='system-ui,sans-serif' font-size='12'"
_MOST = 1500  # points of a line


@dataclass(frozen=True)
class Line:
    """A line to draw: its name in the legend, [N] x and y (gaps where not finite), and style."""

    name: str
    x: Array
    y: Array
    colour: str = _PALETTE[0]
    dots: bool = False
    dashed: bool = False


@dataclass(frozen=True)
class Bars:
    """Bars of one colour, one per group: values, spreads and single values; None where missing."""

    name: str
    values: Sequence[float | None]
    spreads: Sequence[float | None] = ()
    singles: Sequence[Sequence[float]] = ()


def colour(number: int) -> str:
    """The colour of the n-th line or bar; after eight they come again, darker each time."""
    again, which = divmod(number, len(_PALETTE))
    parts = (int(_PALETTE[which][k : k + 2], 16) for k in (1, 3, 5))
    return "#" + "".join(f"{round(part * _DARKER**again):02x}" for part in parts)


def document(body: str, width: float, height: float, title: str) -> str:
    """An SVG file around shapes; it can stand alone or inside of a page."""
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width:g} {height:g}' "
        f"width='{width:g}' height='{height:g}' role='img' {_FONT} fill='{_INK}'>"
        f"<title>{escape(title)}</title>"
        f"<rect width='{width:g}' height='{height:g}' fill='white'/>{body}</svg>\n"
    )


def line_chart(
    title: str,
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    size: tuple[int, int] = (760, 300),
) -> str:
    """Lines over a common x axis; y starts at 0 if nothing is below.

    Where the middle of one line is twenty times that of another, y is logarithmic.
    """
    width, height = size
    box = (_MARGIN, 34.0, width - 14.0, height - 44.0)
    x_low, x_high = _span([line.x for line in lines])
    y_low, y_high = _span([line.y for line in lines])
    middles = [
        float(np.median(y)) for y in (line.y[np.isfinite(line.y)] for line in lines) if len(y)
    ]
    log = y_low >= 0 and _far_apart(middles)
    y_low = min(middles) / 10 if log else min(0.0, y_low)
    up = (y_low, y_high * 1.05 if y_high > 0 else y_high + 1.0)
    frame = _Frame(box, (x_low, x_high), up, log)
    body = [_text(box[0], 20, title, weight=True), frame.axes(x_label, y_label)]
    body += [frame.line(line) for line in lines]
    body.append(_legend([(line.name, line.colour) for line in lines], box[2], 20))
    return document("".join(body), width, height, title)


def path_panels(
    title: str, lines: Sequence[tuple[str, Array, str, bool]], unit: str, panel: int = 330
) -> str:
    """Paths in space seen along each axis, all axes to one scale.

    Args:
        lines: name, [N,3] points, colour, and whether it is dashed.
        unit: of the points.
    """
    everything = np.concatenate([points for _, points, _, _ in lines])
    centre = (everything.min(axis=0) + everything.max(axis=0)) / 2
    reach = max(float((everything.max(axis=0) - everything.min(axis=0)).max()) * 0.55, 1e-9)
    width, height = 3 * panel + 14, panel + 44
    body = [_text(14, 20, title, weight=True)]
    for number, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        left = number * panel
        box = (left + _MARGIN, 34.0, left + float(panel), height - 44.0)
        square = min(box[2] - box[0], box[3] - box[1])
        box = (box[0], box[1], box[0] + square, box[1] + square)
        frame = _Frame(
            box,
            (centre[a] - reach, centre[a] + reach),
            (centre[b] - reach, centre[b] + reach),
        )
        body.append(frame.axes(f"{'xyz'[a]} [{unit}]", f"{'xyz'[b]} [{unit}]", few=True))
        for name, points, stroke, dashed in lines:
            body.append(frame.line(Line(name, points[:, a], points[:, b], stroke, dashed=dashed)))
    body.append(_legend([(name, stroke) for name, _, stroke, _ in lines], width - 14, 20))
    return document("".join(body), width, height, title)


def bar_chart(
    title: str, groups: Sequence[str], bars: Sequence[Bars], y_label: str, width: int = 960
) -> str:
    """Groups of bars with their spread as a whisker and single values as dots.

    Where one is twenty times another, heights are logarithmic: else all but the largest look alike.
    """
    height = 320
    box = (_MARGIN, 34.0 + 18.0 * math.ceil(len(bars) / 6), width - 14.0, height - 34.0)
    tops = [v + (s or 0.0) for b in bars for v, s in _with_spread(b) if v is not None]
    tops += [single for b in bars for one in b.singles for single in one]
    known = [v for b in bars for v in b.values if v is not None]
    log = _far_apart(known)
    up = (min(known) / 2 if log else 0.0, max(tops, default=1.0) * 1.08 or 1.0)
    frame = _Frame(box, (0.0, float(len(groups))), up, log)
    body = [_text(box[0], 20, title, weight=True), frame.axes("", y_label, across=False)]
    share = 0.84 / max(len(bars), 1)
    for g, group in enumerate(groups):
        body.append(_text(frame.x(g + 0.5), height - 14, group, "middle"))
        for n, bar in enumerate(bars):
            left = g + 0.08 + n * share
            body.append(_bar(frame, bar, g, left, share, colour(n)))
    for row in range(0, len(bars), 6):
        some = [(bar.name, colour(row + k)) for k, bar in enumerate(bars[row : row + 6])]
        body.append(_legend(some, box[2], 38 + 18 * (row // 6)))
    return document("".join(body), width, height, title)


def _far_apart(values: Sequence[float]) -> bool:
    """Whether these are all positive, and one is twenty times another."""
    return len(values) > 1 and min(values) > 0 and max(values) > 20 * min(values)


def _with_spread(bar: Bars) -> list[tuple[float | None, float | None]]:
    spreads = list(bar.spreads) or [None] * len(bar.values)
    return list(zip(bar.values, spreads, strict=True))


def _bar(frame: _Frame, bar: Bars, group: int, left: float, share: float, fill: str) -> str:
    value, spread = _with_spread(bar)[group]
    if value is None:
        return _text(frame.x(left + share / 2), frame.box[3] - 4, "-", "middle")
    x0, x1 = frame.x(left), frame.x(left + 0.9 * share)
    top, bottom = frame.y(value), frame.box[3]
    label = escape(f"{bar.name}: {value:.4g}" + (f" ± {spread:.2g}" if spread else ""))
    parts = [
        f"<rect x='{x0:.1f}' y='{top:.1f}' width='{x1 - x0:.1f}' height='{bottom - top:.1f}' "
        f"fill='{fill}'><title>{label}</title></rect>"
    ]
    middle = (x0 + x1) / 2
    if spread:
        low, high = frame.y(max(value - spread, 0.0)), frame.y(value + spread)
        parts.append(f"<path d='M{middle:.1f} {low:.1f}V{high:.1f}' stroke='{_INK}'/>")
    singles = bar.singles[group] if bar.singles else ()
    if len(singles) > 1:
        parts += [
            f"<circle cx='{middle:.1f}' cy='{frame.y(single):.1f}' r='2' fill='white' "
            f"stroke='{_INK}'/>"
            for single in singles
        ]
    return "".join(parts)


class _Frame:
    """A box of the picture (left, top, right, bottom) that shows a range of x and y.

    With `log` y is logarithmic, and what is below its range stands at its lower end.
    """

    def __init__(
        self,
        box: tuple[float, float, float, float],
        across: tuple[float, float],
        up: tuple[float, float],
        log: bool = False,
    ) -> None:
        self.box, self.across, self.up, self.log = box, across, up, log

    def x(self, value: float) -> float:
        low, high = self.across
        return self.box[0] + (value - low) / (high - low) * (self.box[2] - self.box[0])

    def y(self, value: float) -> float:
        low, high = self.up
        if self.log:
            low, high, value = (math.log10(v) for v in (low, high, max(value, low)))
        return self.box[3] - (value - low) / (high - low) * (self.box[3] - self.box[1])

    def axes(self, x_label: str, y_label: str, across: bool = True, few: bool = False) -> str:
        """Grid lines with their numbers, and the labels of the axes."""
        left, top, right, bottom = self.box
        parts = []
        for value in _powers(*self.up) if self.log else _ticks(*self.up, 4 if few else 5):
            y = self.y(value)
            parts.append(f"<path d='M{left:.1f} {y:.1f}H{right:.1f}' stroke='{_GREY}'/>")
            parts.append(_text(left - 6, y + 4, f"{value:.6g}", "end"))
        for value in _ticks(*self.across, 4 if few else 8) if across else ():
            x = self.x(value)
            parts.append(f"<path d='M{x:.1f} {top:.1f}V{bottom:.1f}' stroke='{_GREY}'/>")
            parts.append(_text(x, bottom + 16, f"{value:.6g}", "middle"))
        parts.append(f"<path d='M{left:.1f} {top:.1f}V{bottom:.1f}H{right:.1f}' "
                     f"fill='none' stroke='{_INK}'/>")  # fmt: skip
        parts.append(_text((left + right) / 2, bottom + 34, x_label, "middle"))
        x, y = left - _MARGIN + 14, (top + bottom) / 2
        parts.append(
            f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='middle' "
            f"transform='rotate(-90 {x:.1f} {y:.1f})'>{escape(y_label)}</text>"
        )
        return "".join(parts)

    def line(self, line: Line) -> str:
        """A polyline, broken where a value is not finite."""
        step = max(1, math.ceil(len(line.x) / _MOST))
        points = [(float(x), float(y)) for x, y in zip(line.x[::step], line.y[::step], strict=True)]
        commands, pen = [], "M"
        for x, y in points:
            if not (math.isfinite(x) and math.isfinite(y)):
                pen = "M"
                continue
            commands.append(f"{pen}{self.x(x):.1f} {self.y(y):.1f}")
            pen = "L"
        if line.dots:
            return "".join(
                f"<circle cx='{self.x(x):.1f}' cy='{self.y(y):.1f}' r='2.5' fill='{line.colour}'/>"
                for x, y in points
                if math.isfinite(x) and math.isfinite(y)
            )
        dash = " stroke-dasharray='5 4'" if line.dashed else ""
        return (
            f"<path d='{''.join(commands)}' fill='none' stroke='{line.colour}' "
            f"stroke-width='1.6' stroke-linejoin='round'{dash}/>"
        )


def _ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers within a range: 1, 2 or 5 times a power of ten apart."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(f * power for f in (1.0, 2.0, 5.0, 10.0) if raw <= f * power * (1 + 1e-9))
    first = math.ceil(low / step - 1e-9)
    # Adding 0 turns -0 into 0.
    return [k * step + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _powers(low: float, high: float) -> list[float]:
    """1, 2 and 5 times the powers of ten within a range; of a wide one the powers alone."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    times = (1, 2, 5) if last - first <= 3 else (1,)
    every = [float(f"{f}e{k}") for k in range(first, last + 1) for f in times]
    return [value for value in every if low <= value <= high]


def _span(values: Sequence[Array]) -> tuple[float, float]:
    finite = [v[np.isfinite(v)] for v in values]
    together = np.concatenate(finite) if finite else np.zeros(0)
    if not len(together):
        return 0.0, 1.0
    low, high = float(together.min()), float(together.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _legend(entries: Sequence[tuple[str, str]], right: float, y: float) -> str:
    parts: list[str] = []
    for name, stroke in reversed(entries):
        # About the width of the text: its length is not known before it is drawn.
        right -= 7.0 * len(name)
        parts.append(_text(right, y, name))
        parts.append(
            f"<rect x='{right - 16:.1f}' y='{y - 9:.1f}' width='11' height='9' fill='{stroke}'/>"
        )
        right -= 32
    return "".join(parts)


def _text(x: float, y: float, text: str, anchor: str = "start", weight: bool = False) -> str:
    if not text:
        return ""
    bold = " font-weight='600'" if weight else ""
    return f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}'{bold}>{escape(text)}</text>"
