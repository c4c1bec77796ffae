"""Trajectories in the TUM format: `t tx ty tz qx qy qz qw`, seconds, camera to world."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from droidw.errors import InputError
from droidw.io.files import atomic_write, read_text
from droidw.io.rising import rising
from droidw.slam.frame import Trajectory

__all__ = ["read_tum", "write_tum"]

_HEADER = "# timestamp tx ty tz qx qy qz qw (seconds, camera to world, OpenCV axes)\n"
_VALID = "a row is `timestamp tx ty tz qx qy qz qw`, camera to world, times strictly rising"
_SHOWN = 5
# So many rows, and this share of them, may be out of the order of time and still be single strays.
_FEW, _STRAYS = 3, 0.1


def read_tum(path: Path | str, *, problems: list[str] | None = None) -> Trajectory:
    """Read a trajectory; comments start with #, columns are parted by blanks or commas.

    Quaternions within 5 % of unit length are made unit.

    Args:
        path: the file.
        problems: None to refuse a bad row; a list to skip bad rows, each with a sentence
            appended (the first few alone, the rest counted). Single stray times are bad rows;
            where more than a tenth of the rows would be (and than three), they are in another
            order, and are put in that of time.
    Raises:
        InputError: the file is missing or no text, a row is bad (with its line number), or no
            row is left.
    """
    path = Path(path)
    read: list[tuple[int, list[float]]] = []
    bad: list[tuple[int, str]] = []
    for number, line in enumerate(read_text(path, "a trajectory in TUM format").splitlines(), 1):
        fields = line.split("#", 1)[0].replace(",", " ").split()
        if not fields:
            continue
        row, fault = _parse(fields)
        if not fault and problems is None and read:
            fault = _not_after(row[0], read[-1][1][0])
        if fault and problems is None:
            raise InputError(f"{path}, line {number}: {fault}", _VALID)
        if fault:
            bad.append((number, fault))
        else:
            read.append((number, row))
    # One stray time costs no other row.
    kept = rising([row[0] for _, row in read])
    times = len({row[0] for _, row in read})
    if problems is not None and times - len(kept) > max(_FEW, _STRAYS * times):
        problems.append(f"{path.name}: rows are not in the order of time; put in that order")
        read.sort(key=lambda numbered: numbered[1][0])
        kept = rising([row[0] for _, row in read])
    rows = [read[k][1] for k in kept]
    if problems is not None:
        bad += _strays(read, kept)
        said = [
            f"{path.name}, line {number}: {fault}; row skipped" for number, fault in sorted(bad)
        ]
        problems.extend(said[:_SHOWN])
        if len(bad) > _SHOWN:
            problems.append(f"{path.name}: {len(bad) - _SHOWN} more bad rows skipped")
    if not rows:
        raise InputError(f"{path} holds no pose", _VALID)
    table = np.array(rows, dtype=np.float64)
    table[:, 4:] /= np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
    return Trajectory(times=table[:, 0].copy(), T_wc=table[:, 1:].copy())


def _not_after(time: float, last: float) -> str:
    """What is wrong with a time after that one; "" if nothing."""
    relation = "repeats" if time == last else "runs backwards from"
    return f"time stamp {time!r} {relation} {last!r}" if time <= last else ""


def _strays(
    read: Sequence[tuple[int, list[float]]], kept: Sequence[int]
) -> Iterator[tuple[int, str]]:
    """Line and fault of the rows that were not kept."""
    last, among = -math.inf, set(kept)
    for k, (number, row) in enumerate(read):
        if k in among:
            last = row[0]
        else:
            ahead = f"time stamp {row[0]!r} lies ahead of the rows after it"
            yield number, _not_after(row[0], last) or ahead


def _parse(fields: list[str]) -> tuple[list[float], str]:
    """Numbers of one row and what is wrong with it ("" if nothing)."""
    if len(fields) != 8:
        return [], f"{len(fields)} columns, expected 8"
    row: list[float] = []
    for text in fields:
        try:
            row.append(float(text))
        except ValueError:
            return [], f"'{text}' is not a number"
        if not math.isfinite(row[-1]):
            return [], f"'{text}' is not a finite number"
    norm = math.hypot(*row[4:])
    if abs(norm - 1.0) > 0.05:
        return [], f"the quaternion has length {norm:.3g}, not 1"
    return row, ""


def write_tum(
    path: Path | str, trajectory: Trajectory, *, header: bool = True, digits: int = 9
) -> None:
    """Write a trajectory: exactly 8 columns, the same bytes for the same numbers.

    Times keep every digit of their float64. The file appears whole or not at all.

    Args:
        path: the file to write; an existing one is replaced.
        trajectory: T_wc [N,7], times [N] in seconds.
        header: begin with a comment line that names the columns.
        digits: significant ones of a value; 9 hold a millimetre up to a thousand kilometres.
    Raises:
        ValueError: a value is not finite.
        UsageError: the file cannot be written.
    """
    if not (np.isfinite(trajectory.times).all() and np.isfinite(trajectory.T_wc).all()):
        raise ValueError("a trajectory with values that are not finite cannot be written")
    lines = [_HEADER] if header else []
    for time, pose in zip(trajectory.times, trajectory.T_wc, strict=True):
        stamp = np.format_float_positional(time, unique=True, trim="k", min_digits=6)
        # Adding zero turns -0.0 into 0.0.
        values = " ".join(f"{value + 0.0:.{digits}g}" for value in pose.tolist())
        lines.append(f"{stamp} {values}\n")
    with atomic_write(Path(path)) as stream:
        stream.write("".join(lines).encode("ascii"))
