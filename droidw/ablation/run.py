"""An ablation from its cells to its table: what is finished stays, what is not runs."""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from droidw.ablation.cells import Cell, Outcome, forget, prepare, read_outcome
from droidw.ablation.files import write_files
from droidw.ablation.local import Tell, run_local
from droidw.ablation.on_ray import require_ray, run_on_ray
from droidw.ablation.plan import Plan
from droidw.ablation.table import Table, make_table
from droidw.errors import UsageError

__all__ = ["Executor", "Means", "run_ablation"]

Executor = Literal["local", "ray"]


@dataclass(frozen=True)
class Means:
    """With what cells are run.

    Attributes:
        executor: processes of this machine, or tasks of Ray.
        jobs: cells at a time. limit: seconds per cell, None for as long as it takes.
        address: of a Ray cluster, or None for one of our own.
        plugin_files: as given with --plugin. data: folder of datasets, or None for the usual one.
        again: run finished cells again.
    """

    executor: Executor = "local"
    jobs: int = 1
    limit: float | None = None
    address: str | None = None
    plugin_files: tuple[str, ...] = ()
    data: Path | None = None
    again: bool = False


def run_ablation(
    plan: Plan,
    cells: Sequence[Cell],
    folder: Path,
    means: Means,
    tell: Tell,
    stopped: Callable[[], bool] = lambda: False,
    command: str = "",
) -> Table:
    """Run the cells that have no result yet, and write the table of all.

    The table is written whatever happens: also when cells fail, and when the run is stopped.

    Args:
        plan, cells: what is run. folder: for cells and tables; made if it is not there.
        means: with what.
        tell: hears of every cell: "kept" (finished earlier), "missing" (cannot run here),
            "running", "done", "failed".
        stopped: asked often; once it says yes, running cells are ended.
        command: how this was called, for the table.
    Raises:
        UsageError: the folder holds something else, or another ablation runs in it.
        MissingRequirementError: Ray is asked for and not installed.
    """
    if means.executor == "ray":
        require_ray()
    outcomes: dict[str, Outcome] = {}
    with _alone(folder):
        waiting: list[tuple[Cell, Path]] = []
        for cell in cells:
            place = folder / "cells" / cell.name
            if cell.missing:
                tell(cell, "missing", None)
                continue
            found = None if means.again else read_outcome(cell, place, plan.measure)
            if found is not None:
                outcomes[cell.name] = found
                tell(cell, "kept", found)
                continue
            prepare(cell, place, plan.measure, means.plugin_files, means.data)
            waiting.append((cell, place))

        def heard(cell: Cell, state: str, outcome: Outcome | None) -> None:
            if outcome is not None:
                outcomes[cell.name] = outcome
            tell(cell, state, outcome)

        try:
            if not waiting:
                pass
            elif means.executor == "ray":
                cpus = plan.needs.get("cpus")
                run_on_ray(waiting, heard, means.jobs, means.limit, stopped, means.address, cpus)
            else:
                run_local(waiting, heard, means.jobs, means.limit, stopped)
        finally:
            for cell, place in waiting:
                forget(place)
                # One that was not started keeps what came of it earlier (`means.again`).
                if cell.name not in outcomes and (kept := read_outcome(cell, place, plan.measure)):
                    outcomes[cell.name] = kept
            table = make_table(plan, [(cell, outcomes.get(cell.name)) for cell in cells])
            write_files(table, folder, command)
    return table


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder of an ablation, so that no two write into it at a time.

    Raises:
        UsageError: it holds something else, cannot be written, or is held by another.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = {entry.name for entry in folder.iterdir()}
        if held and not {"cells", ".lock"} & held:
            raise UsageError(
                f"{folder}: the output folder holds something that is no ablation "
                f"({', '.join(sorted(held)[:4])})",
                "give another folder: -o DIR",
            )
        lock = (folder / ".lock").open("w")
    except OSError as error:
        raise UsageError(
            f"{folder}: cannot be the output folder: {error.strerror or error}",
            "give a folder that you may write to: -o DIR",
        ) from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UsageError(
                f"{folder}: another `droidw ablate` works in this folder",
                "wait for it, or give another folder: -o DIR",
            ) from error
        (folder / "cells").mkdir(exist_ok=True)
        yield
