"""The figures of an evaluation as text for a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from droidw.eval.summary import Evaluation

if TYPE_CHECKING:
    from droidw.eval.metrics import TrajectoryScore

__all__ = ["table"]


def table(evaluation: Evaluation) -> str:
    """The figures as text for a terminal, with the story behind them."""
    columns = []
    if evaluation.frames is not None:
        columns.append(("all frames", evaluation.frames))
    if evaluation.keyframes is not None:
        columns.append(("keyframes", evaluation.keyframes))
    lines = _trajectory(columns) if columns else []
    masks = evaluation.masks
    if masks is not None:
        lines.append(
            f"  motion masks, {masks.frames} frames, {100 * masks.moving:.1f} % moving:"
            f" AUC {_number(masks.auc)}  best F1 {_number(masks.f1)}  IoU {_number(masks.iou)}"
        )
    notes = [*evaluation.notes]
    for _, scored in columns:
        notes += scored.notes
    notes += masks.notes if masks is not None else ()
    lines += [f"  note: {note}" for note in dict.fromkeys(notes)]
    return "\n".join(lines)


def _trajectory(columns: list[tuple[str, TrajectoryScore]]) -> list[str]:
    """Lines of the figures of poses, a column each."""
    first = columns[0][1]
    unit = first.unit
    rows: list[tuple[str, list[str]]] = [("", [name for name, _ in columns])]

    def row(label: str, values: list[str]) -> None:
        rows.append((label, values))

    row("matched / poses", [f"{s.matched} / {s.frames}" for _, s in columns])
    row(f"path length [{unit}]", [f"{s.path_length:.3f}" for _, s in columns])
    row("scale applied", [f"{s.scale:.5g}" for _, s in columns])
    for figure in ("rmse", "median", "mean", "max", "std"):
        row(f"ATE {figure} [{unit}]", [f"{getattr(s.ate, figure):.4f}" for _, s in columns])
    row("ATE rmse [% of path]", [_percent(s.ate_percent) for _, s in columns])
    row(
        f"RPE rmse [{unit}]",
        [f"{s.rpe_trans.rmse:.4f}" if s.rpe_trans else "-" for _, s in columns],
    )
    row("RPE rmse [deg]", [f"{s.rpe_rot.rmse:.4f}" if s.rpe_rot else "-" for _, s in columns])
    width = max(len(label) for label, _ in rows)
    lines = [
        f"{first.estimate}  against  {first.reference}",
        f"  {first.matched:,} of {first.frames:,} stamps matched with {first.ref_frames:,} of the "
        f"reference; largest difference {1e3 * first.worst_diff:.1f} ms (allowed "
        f"{1e3 * first.max_diff:g} ms)",
    ]
    lines += [
        f"  {label:<{width}}  " + "".join(f"{value:>13}" for value in values)
        for label, values in rows
    ]
    lines.append(
        f"  alignment {first.align}; RPE over {first.delta} (all pairs); the matched frames span "
        f"{100 * first.time_covered:.0f} % of the reference"
    )
    if first.normalise != "none":
        what = {"displacement": "distance from its first to its last pose", "path": "path"}
        lines.append(
            f"  all lengths are divided by the reference's {what[first.normalise]}, so that "
            "the unit of the reference does not matter"
        )
    return lines


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
