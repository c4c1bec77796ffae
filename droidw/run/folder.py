"""The run folder: made before anything heavy loads, and never at the cost of somebody's files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path

from droidw.errors import UsageError

__all__ = ["FILES", "finish", "listed", "prepare"]

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

_WITHIN = ("depth/full",)
_EARLIER = ".earlier"
"""Folder in the run folder, of what an earlier run left there, until a new one has something."""


def prepare(run_dir: Path, overwrite: bool, inputs: Mapping[str, str] | None = None) -> bool:
    """Make the folder, or set aside what an earlier run left there.

    Only files of an earlier run are ever touched, and only with `overwrite`; `finish` deletes them.

    Args:
        run_dir: the folder. overwrite: whether it may hold an earlier run.
        inputs: key -> path of what this run reads, which must not be replaced.
    Returns:
        Whether the folder was not there before.
    Raises:
        UsageError: the folder holds something, or cannot be written, or is read from.
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
    for key, path in (inputs or {}).items():
        if Path(path).exists() and Path(path).resolve().is_relative_to(run_dir.resolve()):
            raise UsageError(
                f"{key}: {path} lies in the output folder {run_dir}, of which --overwrite replaces "
                "what an earlier run left",
                "copy it to another place first, or give another folder: -o FOLDER",
            )
    finish(run_dir, fresh=False)  # of a run that was killed
    _move(run_dir, run_dir / _EARLIER)
    return fresh


def finish(run_dir: Path, fresh: bool) -> None:
    """Delete what an earlier run left, if this one has something to keep; else leave no trace.

    A run that is refused before it has tracked anything takes back its folder, or leaves the
    earlier run as it was.

    Args:
        run_dir: as prepared. fresh: what `prepare` said.
    """
    earlier, own = run_dir / _EARLIER, _files(run_dir)
    if {path.name for path in own} <= {"config.yaml", "log.txt"}:
        for path in own:
            path.unlink()
        _move(earlier, run_dir)
        if fresh and not any(run_dir.iterdir()):
            run_dir.rmdir()
    shutil.rmtree(earlier, ignore_errors=True)


def listed(run_dir: Path, later: Collection[str]) -> dict[str, str]:
    """What lies in the folder, or will `later`, and what it means."""
    return {
        name: meaning
        for name, meaning in FILES.items()
        if (run_dir / name).exists() or name in later
    }


def _files(run_dir: Path) -> list[Path]:
    """The files of a run that are in a folder; links as such, and no folders of somebody else."""
    found = []
    for name in (*FILES, *_WITHIN):
        path = run_dir / name
        inner = path.is_dir() and not path.is_symlink()
        for entry in sorted(path.iterdir()) if inner else [path]:
            if entry.is_symlink() or entry.is_file():
                found.append(entry)
    return found


def _move(source: Path, target: Path) -> None:
    """Move the files of a run, each to its place in another folder."""
    for path in _files(source):
        place = target / path.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        path.replace(place)
