"""Figures of the report as inline SVG; colours come from the page's style sheet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from droidw_plugins.observers._html import escape

__all__ = ["Line", "error_chart", "nice_step", "path_view"]

# Mean width of a character of a note, in units of the drawing.
_CHARACTER = 6.5

Array = npt.NDArray[np.float64]
_MOST = 1200


@dataclass(frozen=True)
class Line:
    """A path to draw: points [N,2] in figure axes, and the CSS class of its stroke."""

    points: Array
    css: str


def nice_step(span: float, parts: float) -> float:
    """The largest of 1, 2, 5 times a power of ten of which `parts` fit into `span`."""
    if not (np.isfinite(span) and span > 0):
        return 1.0
    raw = span / parts
    power = 10.0 ** np.floor(np.log10(raw))
    for factor in (5.0, 2.0, 1.0):
        if raw >= factor * power * (1 - 1e-9):
            return float(factor * power)
    return float(power)


def path_view(
    title: str,
    axes: tuple[str, str],
    lines: list[Line],
    dots: Array,
    bar: Callable[[float], str],
    least_span: float = 0.0,
    size: tuple[int, int] = (520, 380),
) -> str:
    """Paths seen along one axis, both axes to one scale.

    Args:
        title: accessible name of the figure.
        axes: names of the horizontal and the upward axis.
        lines: paths; the last one is that of the estimate and carries the start and end marks.
        dots: [K,2] keyframes.
        bar: label of a scale bar of this length in the units of the points. It is as long as suits
            the figure: a third of its width at most.
        least_span: the figure shows at least this much, so that a still camera looks still.
        size: width and height of the figure in its own units.
    """
    width, height = size
    margin, foot = 26.0, 34.0
    points = [line.points for line in lines if len(line.points)]
    everything = np.concatenate(points) if points else np.zeros((1, 2))
    low, high = everything.min(axis=0), everything.max(axis=0)
    centre, span = (low + high) / 2, high - low
    inner = np.array([width - 2 * margin, height - margin - foot - 12])
    smallest = max(least_span, 1e-9)
    per_unit = float(min(inner / np.maximum(span, smallest * inner / inner.max())))

    def place(values: Array) -> Array:
        moved = (values - centre) * per_unit
        x = width / 2 + moved[:, 0]
        y = (margin + (height - foot - 12)) / 2 - moved[:, 1]
        return np.stack([x, y], axis=1)

    step = nice_step(float(inner.max()) / per_unit, 5)
    parts = [
        f'<svg class="plot" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{escape(title)}">',
        f"<title>{escape(title)}</title>",
        _grid(centre, per_unit, step, width, height - foot, place),
    ]
    for line in lines:
        if len(line.points):
            parts.append(_polyline(place(_thin(line.points)), line.css))
    if len(dots):
        radius = 2.2 if len(dots) <= 400 else 1.4
        parts += [
            f'<circle class="key" cx="{x:.1f}" cy="{y:.1f}" r="{radius}"/>'
            for x, y in place(_thin(dots, 600))
        ]
    if lines and len(lines[-1].points):
        (sx, sy), (ex, ey) = place(lines[-1].points[[0, -1]])
        parts.append(f'<circle class="start" cx="{sx:.1f}" cy="{sy:.1f}" r="5.5"/>')
        parts.append(
            f'<rect class="end" x="{ex - 4.8:.1f}" y="{ey - 4.8:.1f}" width="9.6" height="9.6"/>'
        )
    units = nice_step(float(inner[0]) / per_unit, 3)
    length, said = units * per_unit, bar(units)
    y = height - 14
    # Beside the bar, or above it where the name of the axis would be in the way.
    beside = length + _CHARACTER * len(said) < 0.55 * width
    label = (margin + length + 10, y + 4) if beside else (margin, y - 10)
    parts += [
        f'<path class="bar" d="M{margin} {y - 4}v8M{margin} {y}h{length:.2f}m0 -4v8"/>',
        f'<text class="note" x="{label[0]:.1f}" y="{label[1]:.1f}">{escape(said)}</text>',
        f'<text class="note end-text" x="{width - 10}" y="{y + 4}">{escape(axes[0])} →</text>',
        f'<text class="note" x="10" y="18">↑ {escape(axes[1])}</text>',
        "</svg>",
    ]
    return "".join(parts)


def _grid(
    centre: Array, per_unit: float, step: float, width: int, bottom: float, place: object
) -> str:
    assert callable(place)
    half = np.array([width / 2, bottom / 2]) / per_unit
    commands = []
    for axis in (0, 1):
        first = np.ceil((centre[axis] - half[axis]) / step)
        last = np.floor((centre[axis] + half[axis]) / step)
        for number in np.arange(first, min(last, first + 60) + 1):
            point = centre.copy()
            point[axis] = number * step
            x, y = place(point[None])[0]
            if axis == 0 and 0 < x < width:
                commands.append(f"M{x:.1f} 0V{bottom:.0f}")
            elif axis == 1 and 0 < y < bottom:
                commands.append(f"M0 {y:.1f}H{width}")
    return f'<path class="grid" d="{"".join(commands)}"/>'


def error_chart(
    times: Array,
    errors: Array,
    rmse: float,
    keyframe_times: Array,
    unit: str,
    size: tuple[int, int] = (1080, 240),
) -> str:
    """Position error over time, with its RMSE and a tick for every keyframe.

    Args:
        times, errors: [M] seconds and errors in `unit`.
        rmse: drawn as a dashed line.
        keyframe_times: [K] seconds.
        unit: label of the errors.
        size: width and height of the figure in its own units.
    """
    width, height = size
    left, right, top, bottom = 62.0, 14.0, 34.0, 34.0
    t0, t1 = float(times.min()), float(times.max())
    if t1 <= t0:
        t1 = t0 + 1.0
    most = max(float(errors.max()), rmse, 1e-12)
    step = nice_step(most, 3)
    ceiling = float(np.ceil(most / step - 1e-9) * step)

    def x_of(t: float) -> float:
        return left + (t - t0) / (t1 - t0) * (width - left - right)

    def y_of(e: float) -> float:
        return height - bottom - e / ceiling * (height - top - bottom)

    parts = [
        f'<svg class="plot wide" viewBox="0 0 {width} {height}" role="img" '
        'aria-label="position error over time">',
        "<title>position error over time</title>",
    ]
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    for number in range(round(ceiling / step) + 1):
        y = y_of(number * step)
        parts.append(f'<path class="grid" d="M{left} {y:.1f}H{width - right}"/>')
        parts.append(
            f'<text class="note end-text" x="{left - 8}" y="{y + 4:.1f}">'
            f"{number * step:.{digits}f}</text>"
        )
    t_step = nice_step(t1 - t0, 6)
    t_digits = max(0, -int(np.floor(np.log10(t_step) + 1e-9)))
    for number in range(int((t1 - t0) / t_step + 1e-9) + 1):
        # Counted from the first frame: the stamps of a data set are often those of a Unix clock.
        label, x = number * t_step, x_of(t0 + number * t_step)
        parts.append(
            f'<text class="note mid-text" x="{x:.1f}" y="{height - 10}">'
            f"{label:.{t_digits}f}{' s' if number == 0 else ''}</text>"
        )
    ticks = [x_of(t) for t in keyframe_times.tolist() if t0 <= t <= t1]
    base = height - bottom
    parts.append(f'<path class="tick" d="{"".join(f"M{x:.1f} {base}v5" for x in ticks)}"/>')
    curve = _peaks(np.stack([times, errors], axis=1))
    shown = np.array([[x_of(t), y_of(e)] for t, e in curve])
    area = " ".join(f"{x:.1f},{y:.1f}" for x, y in shown)
    parts.append(
        f'<polygon class="area" points="{shown[0, 0]:.1f},{base} {area} '
        f'{shown[-1, 0]:.1f},{base}"/>'
    )
    parts.append(_polyline(shown, "est"))
    y = y_of(rmse)
    parts.append(f'<path class="mean" d="M{left} {y:.1f}H{width - right}"/>')
    parts.append(
        f'<text class="note" x="{left}" y="19">error [{escape(unit)}] of each frame, '
        f"dashed: RMSE {rmse:.3g} {escape(unit)}</text>"
    )
    parts.append("</svg>")
    return "".join(parts)


def _polyline(points: Array, css: str) -> str:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline class="{css}" points="{text}"/>'


def _thin(points: Array, most: int = _MOST) -> Array:
    """At most `most` points, evenly chosen, the first and the last among them."""
    if len(points) <= most:
        return points
    return np.asarray(points[np.linspace(0, len(points) - 1, most).round().astype(int)])


def _peaks(curve: Array) -> Array:
    """At most `_MOST` points of a curve that keep its peaks."""
    if len(curve) <= _MOST:
        return curve
    blocks = np.array_split(np.arange(len(curve)), _MOST)
    return curve[[int(block[np.argmax(curve[block, 1])]) for block in blocks]]
