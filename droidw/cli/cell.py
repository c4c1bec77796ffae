"""The process of one cell of an ablation: `droidw run`, then its figures.

    python -m droidw.cli.cell FOLDER PARENT

is what `droidw ablate` starts; FOLDER holds `cell.json` and `cell.yaml`. The run goes to
`FOLDER/run`, and when all is done the figures to `FOLDER/result.json`, as a whole: a cell is
finished if that file is there. The process ends with its parent, so that no cell is left running
when an ablation, or a worker of Ray, is killed.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import sys
import threading
import time
from pathlib import Path

from droidw.cli.main import main as droidw

__all__ = ["main"]

_POLL = 0.2


def main(folder: Path, parent: int) -> int:
    """Run one cell and return the exit code.

    Args:
        folder: of the cell. parent: process without which this one is to end.
    """
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    with (folder / ".lock").open("w") as lock:
        # Held until the end: an orphan of a killed parent may need a moment more to notice.
        fcntl.flock(lock, fcntl.LOCK_EX)
        return _run(folder)


def _run(folder: Path) -> int:
    spec = json.loads((folder / "cell.json").read_text(encoding="utf-8"))
    run_dir = folder / "run"
    shutil.rmtree(run_dir, ignore_errors=True)
    began = time.monotonic()
    more = [word for file in spec["plugins"] for word in ("--plugin", file)]
    if spec["data"] is not None:
        more += ["--data", spec["data"]]
    code = droidw(["run", "--config", str(folder / "cell.yaml"), "-o", str(run_dir), *more])
    if code:
        return code

    from droidw.ablation.measure import measure_run
    from droidw.ablation.plan import Measuring
    from droidw.io.files import write_json

    record = {key: spec[key] for key in ("row", "sequence", "seed", "digest", "measure")}
    record.update(measure_run(run_dir, Measuring(**spec["measure"])))
    write_json(folder / "result.json", {**record, "seconds": time.monotonic() - began})
    return 0


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))
