"""The figures of one finished cell, from the files of its run folder."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from droidw.errors import InputError, UsageError
from droidw.eval.summary import evaluate, mask_score, source_of

if TYPE_CHECKING:
    from droidw.ablation.plan import Measuring
    from droidw.eval.metrics import Align, Normalise, TrajectoryScore

__all__ = ["measure_run"]

_CURVE = 300
"""Points of a path or an error that are kept for plots."""


def measure_run(run_dir: Path, how: Measuring) -> dict[str, Any]:
    """Evaluate a run folder as `droidw eval` does, and add the facts of its manifest.

    Footage without a truth has no figures of the trajectory, but may have motion masks.

    Returns:
        "metrics": figures by dotted name; "facts"; "curve": path and errors over time, thinned;
        "notes": sentences.
    """
    manifest = json.loads((run_dir / "manifest.json").read_text(encoding="utf-8"))
    notes: list[str] = []
    curve: dict[str, Any] = {}
    try:
        found = evaluate(
            run_dir,
            None,
            align=cast("Align", how.align),
            normalise=cast("Normalise", how.normalise),
            max_diff=how.t_max_diff,
            masks_after=how.masks_after,
        )
        record = found.to_dict()
        curve = {} if found.frames is None else _curve(found.frames)
    except (UsageError, InputError) as error:
        notes.append(error.message)
        record = _masks(run_dir, how, notes)
    notes += [str(note) for note in record.get("notes", ())]
    metrics = dict(_figures(record))
    for name in ("fps", "seconds", "peak_memory_mb"):
        metrics[name] = float(manifest[name])
    metrics["keyframe_count"] = float(manifest["keyframes"])
    facts = {
        "device": manifest["device"],
        "preset": manifest["preset"],
        "parts": {slot: part["name"] for slot, part in manifest["parts"].items()},
        "versions": manifest["versions"],
        "warnings": manifest.get("warnings", []),
        "unit": record.get("unit", "m"),
        "notes": notes,
    }
    return {"metrics": metrics, "facts": facts, "curve": curve}


def _masks(run_dir: Path, how: Measuring, notes: list[str]) -> dict[str, Any]:
    try:
        found = mask_score(run_dir, source_of(run_dir), None, how.masks_after)
    except InputError as error:
        notes.append(error.message)
        return {}
    return {} if found is None else {"masks": found.to_dict()}


def _figures(record: Mapping[str, Any], prefix: str = "") -> list[tuple[str, float]]:
    """Finite numbers by dotted name."""
    found: list[tuple[str, float]] = []
    for key, value in record.items():
        if isinstance(value, Mapping):
            found += _figures(value, f"{prefix}{key}.")
            continue
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if number and math.isfinite(value):
            found.append((prefix + key, float(value)))
    return found


def _curve(score: TrajectoryScore) -> dict[str, Any]:
    rows = np.unique(np.linspace(0, len(score.times) - 1, _CURVE).round().astype(int))
    return {
        "unit": score.unit,
        "times": np.round(score.times[rows] - score.times[0], 4).tolist(),
        "errors": np.round(score.errors[rows], 6).tolist(),
        "path": np.round(score.aligned[rows], 5).tolist(),
        "truth": np.round(score.truth[rows], 5).tolist(),
    }
