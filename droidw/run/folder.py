"""The run folder: made before anything heavy loads, and never at the cost of somebody's files."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from droidw.errors import UsageError

__all__ = ["FILES", "RunFolder", "listed", "prepare"]

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
_AT_ONCE = ("config.yaml", "log.txt")


@dataclass
class RunFolder:
    """The folder of a run that begins.

    What an earlier run left there stays as it was until this one has something to keep: what it
    writes before that goes to hidden files beside it.

    Attributes:
        path: the folder. fresh: whether it was not there before.
        replaces: whether it holds an earlier run.
        lock: open file by which no other run may write there until `finish`, if locks work there.
    """

    path: Path
    fresh: bool
    replaces: bool
    lock: int | None = None

    def early(self, name: str) -> Path:
        """Where a file of this name goes before there is anything to keep."""
        return self.path / (f".{name}.{os.getpid()}" if self.replaces else name)

    def begin(self) -> None:
        """Delete what an earlier run left, as this one has something to keep.

        Only files that a run writes go, and the folders that are empty then.
        """
        if not self.replaces:
            return
        for path in _files(self.path):
            path.unlink()
        for name in (*_WITHIN, *FILES):
            if (self.path / name).is_dir() and not any((self.path / name).iterdir()):
                (self.path / name).rmdir()
        for name in _AT_ONCE:
            if self.early(name).exists():
                self.early(name).rename(self.path / name)
            for left in self.path.glob(f".{name}.*"):  # of runs that were killed
                left.unlink()
        self.replaces = False

    def finish(self) -> None:
        """Take back what a run wrote that ended before it had anything to keep; free the folder."""
        if self.replaces or {path.name for path in _files(self.path)} <= {*_AT_ONCE}:
            for name in _AT_ONCE:
                self.early(name).unlink(missing_ok=True)
            if self.fresh and not any(self.path.iterdir()):
                self.path.rmdir()
        if self.lock is not None:
            os.close(self.lock)
            self.lock = None


def prepare(run_dir: Path, overwrite: bool, inputs: Mapping[str, str] | None = None) -> RunFolder:
    """Make the folder of a run.

    Args:
        run_dir: the folder. overwrite: whether it may hold an earlier run.
        inputs: key -> path of what this run reads, which must not be replaced.
    Raises:
        UsageError: the folder holds something, or cannot be written, or is read from, or another
            run is writing there.
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
    lock = _locked(run_dir)
    try:
        replaces = bool(held) and _may_replace(run_dir, held, overwrite, inputs or {})
    except UsageError:
        if lock is not None:
            os.close(lock)
        raise
    return RunFolder(run_dir, fresh, replaces, lock)


def _locked(run_dir: Path) -> int | None:
    """An open file that locks the folder for this process, or None where there are no such locks.

    Raises:
        UsageError: another run is writing there.
    """
    try:
        import fcntl
    except ImportError:  # a system without file locks
        return None
    lock = os.open(run_dir, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise UsageError(
            f"{run_dir}: another run is writing into this output folder",
            "give another folder (-o FOLDER), or wait until it has ended",
        ) from error
    except OSError:  # a file system without them
        os.close(lock)
        return None
    return lock


def _may_replace(
    run_dir: Path, held: Sequence[str], overwrite: bool, inputs: Mapping[str, str]
) -> bool:
    """True where what is `held` in the folder is a run that may be replaced; else an error."""
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
    for key, path in inputs.items():
        if Path(path).exists() and Path(path).resolve().is_relative_to(run_dir.resolve()):
            raise UsageError(
                f"{key}: {path} lies in the output folder {run_dir}, of which --overwrite replaces "
                "what an earlier run left",
                "copy it to another place first, or give another folder: -o FOLDER",
            )
    return True


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
