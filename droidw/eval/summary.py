"""`droidw eval` without the command line: a run folder or a file against a reference."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from droidw.errors import InputError, UsageError
from droidw.eval.associate import DEFAULT_MAX_DIFF
from droidw.eval.metrics import Align, Delta, TrajectoryScore, score
from droidw.io.files import atomic_write
from droidw.io.tum import read_tum

if TYPE_CHECKING:
    from droidw.eval.masks import MaskScore
    from droidw.slam.frame import Trajectory

__all__ = ["Evaluation", "evaluate", "reference_file", "source_of", "table", "write_metrics"]


@dataclass(frozen=True)
class Evaluation:
    """All figures of one run.

    Attributes:
        frames: every frame's pose (`trajectory.tum`, or the file that was given).
        keyframes: the same for `keyframes.tum`, or None where there is none.
        masks: the score of the uncertainty maps, or None without maps or masks.
        notes: sentences about what was left out.
    """

    frames: TrajectoryScore
    keyframes: TrajectoryScore | None = None
    masks: MaskScore | None = None
    notes: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: the figures of all frames at the top, `keyframes` and `masks` below."""
        record = self.frames.to_dict()
        record["notes"] = [*record["notes"], *self.notes]
        if self.keyframes is not None:
            record["keyframes"] = self.keyframes.to_dict()
        if self.masks is not None:
            record["masks"] = self.masks.to_dict()
        return {key: _finite(entry) for key, entry in record.items()}


def evaluate(
    path: Path,
    reference: Path | None,
    *,
    align: Align = "sim3",
    max_diff: float = DEFAULT_MAX_DIFF,
    offset: float = 0.0,
    delta: Delta | None = None,
    unit: str = "m",
    masks: Path | None = None,
) -> Evaluation:
    """Evaluate a run folder or a TUM file.

    Args:
        path: run folder with `trajectory.tum`, or a TUM file.
        reference: TUM file, folder that holds `groundtruth.txt`, or None to look in the source
            that the run folder names.
        align, max_diff, offset, delta, unit: as for `score`.
        masks: folder of masks, or None to look for `mask/` in the source of the run.
    Raises:
        UsageError: if no reference is given and none can be found.
        InputError: if a file is missing, is no trajectory or does not match.
    """
    run_dir = path if path.is_dir() else None
    file = path / "trajectory.tum" if run_dir else path
    if not file.is_file():
        raise InputError(
            f"{file}: there is no such file",
            "give a run folder that holds trajectory.tum, or a TUM file (t tx ty tz qx qy qz qw)",
        )
    source = source_of(run_dir) if run_dir else None
    if reference is None:
        reference = _reference_of_source(source)
    ref_file = reference_file(reference)
    truth = _File.read(ref_file)
    options: dict[str, Any] = {
        "align": align,
        "max_diff": max_diff,
        "offset": offset,
        "delta": delta,
        "unit": unit,
    }
    frames = _score_file(_File.read(file), truth, options)
    keyframes = None
    notes: list[str] = []
    if run_dir and (run_dir / "keyframes.tum").is_file():
        key_file = run_dir / "keyframes.tum"
        try:
            keyframes = _score_file(_File.read(key_file), truth, options)
        except InputError as error:
            # A clip with two keyframes has a trajectory worth scoring all the same.
            notes.append(f"keyframes are not scored: {error.message}")
    return Evaluation(frames, keyframes, _mask_score(run_dir, source, masks, notes), tuple(notes))


@dataclass(frozen=True)
class _File:
    """A trajectory file as far as it can be used: bad rows are left out, counted and told."""

    path: Path
    trajectory: Trajectory
    skipped: int
    problems: tuple[str, ...]

    @classmethod
    def read(cls, path: Path) -> _File:
        problems: list[str] = []
        try:
            trajectory = read_tum(path, problems=problems)
        except InputError as error:
            if not problems:
                raise
            first = problems[0].removesuffix("; row skipped")
            raise InputError(f"{error.message}: {first}", error.hint) from error
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        rows = sum(1 for line in lines if line.split("#", 1)[0].strip())
        return cls(path, trajectory, rows - len(trajectory), tuple(problems))


def _score_file(est: _File, ref: _File, options: dict[str, Any]) -> TrajectoryScore:
    scored = score(est.trajectory, ref.trajectory, names=(str(est.path), str(ref.path)), **options)
    return replace(
        scored,
        skipped=scored.skipped + est.skipped,
        ref_skipped=scored.ref_skipped + ref.skipped,
        notes=(*est.problems, *ref.problems, *scored.notes),
    )


def _reference_of_source(source: Path | None) -> Path:
    if source is not None and (source / "groundtruth.txt").is_file():
        return source
    raise UsageError(
        "nothing to compare with: no reference was given, and the run does not name a source "
        "with a groundtruth.txt",
        "give one: --ref FILE (TUM: t tx ty tz qx qy qz qw) or --ref FOLDER (with groundtruth.txt)",
    )


def _mask_score(
    run_dir: Path | None, source: Path | None, masks: Path | None, notes: list[str]
) -> MaskScore | None:
    maps = run_dir / "uncertainty" if run_dir else None
    have_maps = maps is not None and any(maps.glob("[0-9]*.png"))
    if masks is not None and not have_maps:
        raise UsageError(
            "--masks needs a run folder with uncertainty maps (uncertainty/NNNNNN.png)",
            "write them in the run: exporters.uncertainty={}",
        )
    if maps is None or not have_maps:
        return None
    if masks is None:
        if source is None or not (source / "mask").is_dir():
            return None
        masks = source / "mask"
    from droidw.eval.masks import score_folder

    return score_folder(maps, masks)


def reference_file(reference: Path) -> Path:
    """The trajectory file that `--ref` means: itself, or `groundtruth.txt` in a folder.

    Raises:
        InputError: if there is none.
    """
    if reference.is_dir():
        inside = reference / "groundtruth.txt"
        if inside.is_file():
            return inside
        raise InputError(
            f"{reference}: this folder holds no groundtruth.txt", "name the file: --ref FILE"
        )
    if not reference.is_file():
        raise InputError(f"{reference}: there is no such reference file")
    return reference


def source_of(run_dir: Path) -> Path | None:
    """The folder that a run was made from, if its files name one that is still there."""
    named: list[str] = []
    manifest = run_dir / "manifest.json"
    if manifest.is_file():
        try:
            content = json.loads(manifest.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            content = {}
        if isinstance(content, dict):
            named.append(str(content.get("source", "")))
    config = run_dir / "config.yaml"
    if config.is_file():
        try:
            settings = yaml.safe_load(config.read_text(encoding="utf-8"))
        except (OSError, ValueError, yaml.YAMLError):
            settings = {}
        chosen = settings.get("input") if isinstance(settings, dict) else None
        if isinstance(chosen, dict):
            named.append(str(chosen.get("source", "")))
    for text in named:
        for candidate in (text, text.partition(":")[2]):
            if candidate and Path(candidate).is_dir():
                return Path(candidate)
    return None


def write_metrics(evaluation: Evaluation, run_dir: Path) -> Path:
    """Write `metrics.json` into a run folder and return its path."""
    path = run_dir / "metrics.json"
    text = json.dumps(evaluation.to_dict(), indent=2, allow_nan=False) + "\n"
    with atomic_write(path) as stream:
        stream.write(text.encode("utf-8"))
    return path


def table(evaluation: Evaluation) -> str:
    """The figures as text for a terminal, with the story behind them."""
    columns = [("all frames", evaluation.frames)]
    if evaluation.keyframes is not None:
        columns.append(("keyframes", evaluation.keyframes))
    first = evaluation.frames
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
    lines = [f"{first.estimate}  against  {first.reference}"]
    lines += [
        f"  {label:<{width}}  " + "".join(f"{value:>13}" for value in values)
        for label, values in rows
    ]
    lines.append(
        f"  alignment {first.align}; stamps within {first.max_diff:g} s; RPE over {first.delta}"
        f" (all pairs); the matched frames span {100 * first.time_covered:.0f} % of the reference"
    )
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


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _finite(value: Any) -> Any:
    """The same record with None for every number that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
