"""Cells as processes of this machine, a few at a time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from droidw.ablation.cells import Cell, Outcome, take
from droidw.io.files import write_json

__all__ = ["MODULE", "Tell", "attend", "conclude", "launch", "run_local"]

MODULE = "droidw.cli.cell"
"""The module that a cell's process runs."""

Tell = Callable[[Cell, str, "Outcome | None"], None]
"""Hears (cell, "running", None) and (cell, "done" or "failed", outcome)."""

_POLL = 0.1


def launch(folder: Path) -> subprocess.Popen[bytes]:
    """Start the process of a cell that has been prepared; what it says goes to `output.txt`.

    What came of it earlier is given up now and no sooner: cells that wait keep theirs.
    """
    spec = take(folder)
    threads = str(spec["threads"])
    limits = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    with (folder / "output.txt").open("wb") as output:
        # A session of its own: Ctrl-C is for the ablation, which then ends its cells.
        return subprocess.Popen(
            [sys.executable, "-m", MODULE, str(folder.resolve()), str(os.getpid())],
            cwd=spec["folder"],
            env={**os.environ, **dict.fromkeys(limits, threads)},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def end(process: subprocess.Popen[bytes]) -> None:
    """End a cell at once; half a cell is worth nothing."""
    if process.poll() is None:
        process.kill()
    process.wait()


def attend(folder: str, limit: float | None = None) -> tuple[int, float]:
    """Run a prepared cell to its end.

    Args:
        folder: of the cell. limit: seconds after which it is ended.
    Returns:
        Exit code as `subprocess` gives it (negative: the signal), and seconds.
    """
    began = time.monotonic()
    process = launch(Path(folder))
    try:
        code = process.wait(limit)
    except subprocess.TimeoutExpired:
        code = -int(signal.SIGALRM)
    finally:
        end(process)
    return code, time.monotonic() - began


def conclude(folder: Path, code: int, seconds: float, why: str = "") -> Outcome:
    """What a cell that has ended came to; a failure is written to `failure.json`.

    Args:
        folder: of the cell. code: how its process ended, as `subprocess` gives it.
        seconds: how long it took. why: a reason that is known already.
    """
    result = folder / "result.json"
    if code == 0 and result.is_file():
        record = json.loads(result.read_text(encoding="utf-8"))
        return Outcome(record["metrics"], record["facts"], record["curve"], seconds=seconds)
    result.unlink(missing_ok=True)  # else the cell would be finished the next time
    why = why or _why(code, folder, seconds)
    outcome = Outcome({}, {}, {}, why, max(code, 0) or 1, seconds)
    write_json(folder / "failure.json", {"error": outcome.error, "code": code, "seconds": seconds})
    return outcome


def run_local(
    cells: Sequence[tuple[Cell, Path]],
    tell: Tell,
    jobs: int,
    limit: float | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Run cells that have been prepared, `jobs` at a time, and tell of each.

    Args:
        cells: with their folders. tell: hears what happens.
        jobs: processes at a time.
        limit: seconds after which a cell is ended.
        stopped: asked often; once it says yes, running cells are ended and nothing more starts.
    """
    waiting = deque(cells)
    running: list[tuple[Cell, Path, subprocess.Popen[bytes], float]] = []
    try:
        while (waiting or running) and not stopped():
            while waiting and len(running) < jobs:
                cell, folder = waiting.popleft()
                running.append((cell, folder, launch(folder), time.monotonic()))
                tell(cell, "running", None)
            time.sleep(_POLL)
            for entry in list(running):
                cell, folder, process, began = entry
                seconds = time.monotonic() - began
                code = process.poll()
                if code is None and limit is not None and seconds > limit:
                    end(process)
                    code = -int(signal.SIGALRM)
                if code is None:
                    continue
                running.remove(entry)
                outcome = conclude(folder, code, seconds)
                tell(cell, "failed" if outcome.error else "done", outcome)
    finally:
        for _, _, process, _ in running:
            end(process)


def _why(code: int, folder: Path, seconds: float) -> str:
    """One sentence out of what the process said, or out of how it ended."""
    if code == -int(signal.SIGALRM):
        return f"took longer than it may (--limit), ended after {seconds:.0f} s"
    if code < 0:
        known = {int(number): number.name for number in signal.Signals}
        name = known.get(-code, f"signal {-code}")
        hint = ": is memory short?" if name == "SIGKILL" else ""
        return f"its process was ended by {name}{hint}"
    text = (folder / "output.txt").read_text(encoding="utf-8", errors="replace")
    _, found, rest = text.rpartition("droidw: error: ")
    if found and rest.strip():
        return rest.splitlines()[0]
    lines = [line for line in text.splitlines() if line.strip()]
    last = f": {lines[-1]}" if lines else ""
    return f"its process ended with exit code {code}{last}"
