"""Cells as Ray tasks, on this machine or a cluster (extra `ray`)."""

from __future__ import annotations

import importlib.util
import logging
import math
import os
import re
import shutil
import signal
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from droidw.ablation.cells import Cell
from droidw.ablation.local import Tell, attend, conclude
from droidw.errors import DroidwError, MissingRequirementError

__all__ = ["RETRIES", "require_ray", "run_on_ray"]

RETRIES = 3
"""How often a cell is started again whose worker was lost."""

_POLL = 0.5
_REACHED = 10.0  # seconds


def require_ray() -> None:
    """Raise a sentence where Ray is not installed.

    Raises:
        MissingRequirementError: it is not.
    """
    if importlib.util.find_spec("ray") is None:
        raise MissingRequirementError(
            "--executor ray: the package 'ray' is not installed",
            "pip install 'droidw[ray]', or run the cells as processes: --executor local",
        )


def run_on_ray(
    cells: Sequence[tuple[Cell, Path]],
    tell: Tell,
    jobs: int,
    limit: float | None = None,
    stopped: Callable[[], bool] = lambda: False,
    address: str | None = None,
    cpus: float | None = None,
) -> None:
    """Run cells that have been prepared as tasks of Ray, and tell of each.

    The folders must be the same place on all machines of a cluster. A task takes as many CPUs as
    its cell has threads, and the GPUs that the cell wants. Where a worker is lost, Ray starts the
    cell again on another, up to `RETRIES` times; a cell that fails by itself is not tried again.

    Args:
        cells, tell, limit, stopped: as for `run_local`.
        jobs: cells at a time on a local Ray; a cluster decides for itself.
        address: of a running cluster ("auto": the one of this machine), or None for a Ray that
            lives as long as this call.
        cpus: of each task, instead of its threads.
    Raises:
        MissingRequirementError: Ray is not installed.
        DroidwError: Ray cannot be started or reached.
    """
    require_ray()
    # Ray reports on its use over the network unless told otherwise before it is imported.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray

    each = [cpus if cpus is not None else float(cell.threads) for cell, _ in cells]
    place = None if address else tempfile.mkdtemp(prefix="droidw-ray-")
    try:
        room = max(1, round(jobs * max(each, default=1.0)))
        with _own_signals():
            _start(ray.init, address, room, place)
        # A cluster may grow; a Ray of our own has what this machine has.
        resources: Any = ray.cluster_resources
        _run(cells, each, tell, limit, stopped, None if address else resources())
    finally:
        ray.shutdown()
        if place:
            shutil.rmtree(place, ignore_errors=True)


def _start(init: Callable[..., Any], address: str | None, room: int, place: str | None) -> None:
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        if address:
            _reach(address)
            init(address=address, **quiet)
        else:
            init(num_cpus=room, include_dashboard=False, _temp_dir=place, **quiet)
    except Exception as error:
        raise DroidwError(
            f"--executor ray: Ray cannot be started or reached: {error}",
            "check --ray-address, or run the cells as processes: --executor local",
        ) from error


def _reach(address: str) -> None:
    """Raise OSError where nobody answers at host:port, for which Ray waits for minutes."""
    found = re.fullmatch(r"(?:ray://)?\[?([^\]]+?)\]?:(\d+)", address)
    if found:
        socket.create_connection((found[1], int(found[2])), timeout=_REACHED).close()


@contextmanager
def _own_signals() -> Iterator[None]:
    """Ray sets a handler for SIGTERM when it starts; ours, which lose nothing, stay."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(
    cells: Sequence[tuple[Cell, Path]],
    cpus: Sequence[float],
    tell: Tell,
    limit: float | None,
    stopped: Callable[[], bool],
    there: Mapping[str, float] | None,
) -> None:
    """Submit all cells and wait for them; those that need more than is `there` fail at once."""
    from ray import exceptions, get, remote, wait

    task: Any = remote(attend)
    pending = {}
    for (cell, folder), need in zip(cells, cpus, strict=True):
        have = math.inf if there is None else there.get("GPU", 0.0)
        if cell.gpus > have:  # Ray would wait for it for ever
            why = (
                f"it needs {cell.gpus:g} GPUs, and this machine has {have:g} (`needs` of the file)"
            )
            tell(cell, "failed", conclude(folder, 1, 0.0, why))
            continue
        options = {"num_cpus": need, "num_gpus": cell.gpus, "max_retries": RETRIES}
        reference = task.options(name=cell.name, **options).remote(str(folder.resolve()), limit)
        pending[reference] = (cell, folder)
        tell(cell, "running", None)
    while pending and not stopped():
        ready, _ = wait(list(pending), num_returns=1, timeout=_POLL)
        for reference in ready:
            cell, folder = pending.pop(reference)
            try:
                code, seconds = get(reference)
            except exceptions.RayTaskError as error:
                cause = getattr(error, "cause", None) or error
                why = f"{type(cause).__name__}{_first_line(cause)}"
                outcome = conclude(folder, 1, 0.0, f"its task failed: {why}")
            except exceptions.RayError as error:
                lost = f"its worker was lost {RETRIES + 1} times{_first_line(error)}"
                outcome = conclude(folder, 1, 0.0, lost)
            else:
                outcome = conclude(folder, code, seconds)
            tell(cell, "failed" if outcome.error else "done", outcome)


def _first_line(error: BaseException) -> str:
    """A colon and the first line of what an error says; nothing where it says nothing."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return f": {lines[0]}" if lines else ""
