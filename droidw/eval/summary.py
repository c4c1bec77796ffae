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
from droidw.eval.metrics import Align, Delta, Normalise, TrajectoryScore, score
from droidw.io.dataset_tables import table_names
from droidw.io.files import atomic_write
from droidw.io.masks import written_by_droidw
from droidw.io.tum import read_tum

if TYPE_CHECKING:
    from droidw.eval.masks import MaskScore
    from droidw.slam.frame import Trajectory

__all__ = [
    "Evaluation",
    "evaluate",
    "mask_score",
    "reference_file",
    "source_of",
    "told_what_moves",
    "write_metrics",
]


@dataclass(frozen=True)
class Evaluation:
    """All figures of one run.

    Attributes:
        frames: every frame's pose (`trajectory.tum`, or the file that was given), or None where
            no true poses are known and only masks are scored.
        keyframes: the same for `keyframes.tum`, or None where there is none.
        masks: the score of the uncertainty maps, or None without maps or masks.
        notes: sentences about what was left out.
    """

    frames: TrajectoryScore | None
    keyframes: TrajectoryScore | None = None
    masks: MaskScore | None = None
    notes: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: the figures of all frames at the top, `keyframes` and `masks` below."""
        record = {"notes": []} if self.frames is None else self.frames.to_dict()
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
    normalise: Normalise = "none",
    unit: str = "m",
    masks: Path | None = None,
    masks_after: int = 0,
) -> Evaluation:
    """Evaluate a run folder or a TUM file.

    Args:
        path: run folder with `trajectory.tum`, or a TUM file.
        reference: TUM file, folder that holds `groundtruth.txt`, or None for the `truth.tum` of
            the run folder, or the source that the run folder names.
        align, max_diff, offset, delta, normalise, unit: as for `score`.
        masks: folder of masks, or None to look for `mask/` in the source of the run; what is
            wrong with masks that were only found is a note.
        masks_after: leave so many keyframes at the start out of the score of the masks.
    Raises:
        UsageError: if no reference is given and none can be found, and no masks either.
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
    found: MaskScore | None = None
    notes: list[str] = []
    try:
        found = mask_score(run_dir, source, masks, masks_after)
    except InputError as error:
        if masks is not None:
            raise
        # Nobody asked for the masks beside the footage: the trajectory is worth its figures.
        notes.append(f"masks are not scored: {error.message}")
    if found is not None and (given := _given_masks(run_dir)):
        notes.append(told_what_moves(given))
    if found is not None and masks is not None and written_by_droidw(masks):
        notes.append(f"the masks in {masks} are what a run found, not what is known to move")
    reference = reference or _known_reference(run_dir, source)
    if reference is None and found is not None:
        notes.append(f"only masks are scored: {_NO_REFERENCE}")
        return Evaluation(None, masks=found, notes=tuple(notes))
    if reference is None:
        raise UsageError(
            f"nothing to compare with: {_NO_REFERENCE}" + "".join(f"; {note}" for note in notes),
            "give one: --ref FILE (TUM: t tx ty tz qx qy qz qw) or --ref FOLDER (with "
            "groundtruth.txt), or masks of what moves: --masks DIR",
        )
    ref_file = reference_file(reference)
    truth = _File.read(ref_file)
    options: dict[str, Any] = {
        "align": align,
        "max_diff": max_diff,
        "offset": offset,
        "delta": delta,
        "normalise": normalise,
        "unit": unit,
    }
    frames = _score_file(_File.read(file), truth, options)
    keyframes = None
    if run_dir and (run_dir / "keyframes.tum").is_file():
        key_file = run_dir / "keyframes.tum"
        try:
            keyframes = _score_file(_File.read(key_file), truth, options)
        except InputError as error:
            # A clip with two keyframes has a trajectory worth scoring all the same.
            notes.append(f"keyframes are not scored: {error.message}")
    return Evaluation(frames, keyframes, found, tuple(notes))


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


_NO_REFERENCE = (
    "no reference was given, and the run has no truth.tum and does not name a source with a "
    "groundtruth.txt"
)


def told_what_moves(masks: str) -> str:
    """What is to be known of the mask score of a run that was given these masks."""
    return (
        f"the run was told what moves (input.masks: {masks}): the score of its uncertainty is "
        "not of what it found by itself"
    )


def _given_masks(run_dir: Path | None) -> str:
    """The folder of masks that a run was given, or ""."""
    return "" if run_dir is None else str(_input_of(run_dir).get("masks") or "")


def _input_of(run_dir: Path) -> dict[str, Any]:
    """`input` of the configuration that a run folder keeps; empty where there is none."""
    try:
        settings = yaml.safe_load((run_dir / "config.yaml").read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return {}
    chosen = settings.get("input") if isinstance(settings, dict) else None
    return chosen if isinstance(chosen, dict) else {}


def _known_reference(run_dir: Path | None, source: Path | None) -> Path | None:
    if run_dir is not None and (run_dir / "truth.tum").is_file():
        return run_dir / "truth.tum"
    if source is not None and (source / "groundtruth.txt").is_file():
        return source
    return None


def mask_score(
    run_dir: Path | None, source: Path | None, masks: Path | None = None, after: int = 0
) -> MaskScore | None:
    """Score `uncertainty/` of a run folder, or None where there are no maps or no masks.

    Args:
        run_dir: the run folder, or None for a lone trajectory.
        source: what the run was made from; masks: a folder instead of its `mask/`.
        after: leave out so many keyframes at the start.
    Raises:
        UsageError: masks are given, and there are no maps to score.
        InputError: a file cannot be read, or none belongs to another.
    """
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

    return score_folder(maps, masks, after, source)


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
    named.append(str(_input_of(run_dir).get("source", "")))
    for text in named:
        reader, _, rest = text.partition(":")
        # `bonn:balloon` is a sequence by name, and not the folder balloon wherever one stands.
        by_name = reader in table_names() and not Path(rest).is_absolute()
        for candidate in (text, "" if by_name else rest):
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


def _finite(value: Any) -> Any:
    """The same record with None for every number that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
