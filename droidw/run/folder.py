"""The run folder: made before anything heavy loads, and never at the cost of somebody's files."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path

from droidw.errors import UsageError

__all__ = ["FILES", "listed", "prepare", "withdraw"]

FILES: Mapping[str, str] = {
    "trajectory.tum": "pose of every input frame: t tx ty tz qx qy qz qw, camera to world",
    "keyframes.tum": "the same for keyframes only",
    "truth.tum": "the ground truth as the source gives it",
    "points.ply": "static point cloud, coloured",
    "report.html": "this run on one page",
    "metrics.json": "errors against the ground truth",
    "config.yaml": "the resolved configuration; runs again with --config",
    "manifest.json": "versions, parts, timings, what was assumed about the camera",
    "log.txt": "what was logged",
    "uncertainty": "uncertainty per keyframe (16-bit PNG) and as an overlay video",
    "masks": "what moves, per keyframe: black and white PNG",
    "depth": "depth per keyframe (16-bit PNG and NPZ)",
}
"""What a run leaves, by name within the run folder."""


def prepare(run_dir: Path, overwrite: bool) -> bool:
    """Make the folder, or clear it of an earlier run.

    Only files of an earlier run are ever deleted, and only with `overwrite`.

    Returns:
        Whether the folder was not there before.
    Raises:
        UsageError: the folder holds something, or cannot be written.
    """
    fresh = not run_dir.exists()
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        held = sorted(entry.name for entry in run_dir.iterdir())
    except (FileExistsError, NotADirectoryError) as error:
        raise UsageError(
            f"{run_dir}: cannot be the output folder, since a file of that name is in the way",
            "give another folder: -o FOLDER",
        ) from error
    except OSError as error:
        raise UsageError(
            f"{run_dir}: the output folder cannot be made ({error.strerror})",
            "give a folder that you may write to: -o FOLDER",
        ) from error
    if not os.access(run_dir, os.W_OK | os.X_OK):
        raise UsageError(
            f"{run_dir}: the output folder cannot be written to",
            "give a folder that you may write to: -o FOLDER",
        )
    if not held:
        return fresh
    shown = ", ".join(held[:4]) + (", ..." if len(held) > 4 else "")
    if not overwrite:
        raise UsageError(
            f"{run_dir}: the output folder is not empty (it holds {shown})",
            "give another folder (-o FOLDER), or replace the earlier run with --overwrite",
        )
    if not {"config.yaml", "manifest.json", "log.txt"} & set(held):
        raise UsageError(
            f"{run_dir}: --overwrite replaces an earlier run, and this is none (it holds {shown})",
            "give another folder: -o FOLDER",
        )
    for name in FILES:
        _clear(run_dir / name)
    return fresh


def withdraw(run_dir: Path, fresh: bool) -> None:
    """Take back the folder of a run that ended before it had anything to keep.

    Args:
        run_dir: as prepared. fresh: what `prepare` said.
    """
    held = {entry.name for entry in run_dir.iterdir()}
    if held <= {"config.yaml", "log.txt"}:
        for name in held:
            (run_dir / name).unlink()
        if fresh:
            run_dir.rmdir()


def listed(run_dir: Path, later: Collection[str]) -> dict[str, str]:
    """What lies in the folder, or will `later`, and what it means."""
    return {
        name: meaning
        for name, meaning in FILES.items()
        if (run_dir / name).exists() or name in later
    }


def _clear(path: Path) -> None:
    """Delete a file, or the files in an output folder; a link is only unlinked."""
    if path.is_dir() and not path.is_symlink():
        for entry in path.iterdir():
            if entry.is_file() or entry.is_symlink():
                entry.unlink()
    else:
        path.unlink(missing_ok=True)
