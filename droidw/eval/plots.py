"""Pictures of an evaluation: the paths, and the errors over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from droidw.errors import UsageError
from droidw.eval.metrics import TrajectoryScore
from droidw.eval.summary import Evaluation
from droidw.eval.svg import Line, colour, line_chart, path_panels
from droidw.io.files import atomic_write

__all__ = ["write_plots"]


def write_plots(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write `trajectory.svg`, `ate.svg` and, where there is an RPE, `rpe.svg`.

    Args:
        evaluation: all frames are drawn as lines, keyframes as dots.
        folder: made if it is not there; files of these names are replaced.
    Returns:
        The files.
    Raises:
        UsageError: there are no poses to draw, or the folder cannot be made or written to.
    """
    frames = evaluation.frames
    if frames is None:
        raise UsageError(
            "--plot draws errors of poses, and no true poses are known",
            "give a reference: --ref FILE (TUM: t tx ty tz qx qy qz qw)",
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"--plot: cannot make the folder {folder}: {error.strerror or error}",
            "give another folder: --plot DIR",
        ) from error
    pictures = {
        "trajectory.svg": _paths(frames),
        "ate.svg": _errors(frames, evaluation.keyframes),
    }
    if len(frames.rpe_times):
        pictures["rpe.svg"] = _relative(frames)
    written = []
    for name, text in pictures.items():
        with atomic_write(folder / name) as stream:
            stream.write(text.encode("utf-8"))
        written.append(folder / name)
    return written


def _paths(score: TrajectoryScore) -> str:
    title = f"Path, {score.align} alignment, scale {score.scale:.4g}"
    return path_panels(
        title,
        [
            ("reference", score.truth, "#999999", True),
            ("estimate", score.aligned, colour(0), False),
        ],
        score.unit,
    )


def _errors(score: TrajectoryScore, keys: TrajectoryScore | None) -> str:
    begin = float(score.times[0])
    lines = [Line("all frames", score.times - begin, score.errors, colour(0))]
    if keys is not None:
        lines.append(Line("keyframes", keys.times - begin, keys.errors, colour(1), dots=True))
    rmse = score.ate.rmse
    level = np.full(2, rmse)
    ends = score.times[[0, -1]] - begin
    lines.append(Line(f"rmse {rmse:.4g} {score.unit}", ends, level, "#999999", dashed=True))
    return line_chart("Position error", lines, "time [s]", f"ATE [{score.unit}]")


def _relative(score: TrajectoryScore) -> str:
    begin = float(score.times[0])
    x = score.rpe_times - begin
    translation, rotation = score.rpe_errors.T
    # Two figures on one axis: each in units of its own root mean square, named in the legend.
    lines = []
    for n, (values, unit) in enumerate(((translation, score.unit), (rotation, "deg"))):
        rmse = float(np.sqrt(np.mean(values**2)))
        name = f"{'rotation' if n else 'translation'}, rmse {rmse:.4g} {unit}"
        lines.append(Line(name, x, values / rmse if rmse > 0 else values, colour(n)))
    return line_chart(f"Relative error over {score.delta}", lines, "time [s]", "error / rmse")
