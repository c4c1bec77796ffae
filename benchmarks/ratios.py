"""What moving things cost: cells of `droidw ablate` over those of the same clip without movers.

    python benchmarks/ratios.py runs/ablations/unseen/cells.csv [MORE.csv ...]

A clip with movers is called as the one without, an underscore, and what moves: `room4_camel` is
held against `room4`. Means over seeds are geometric, and so are those over clips. Where there is a
row `no-uncertainty`, the clips without movers are held against that as well.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import geometric_mean

FULL, NONE = "full", "no-uncertainty"
BySeed = Mapping[int, float]
ByCell = Mapping[tuple[str, str], BySeed]
"""Of (row, sequence), a figure by seed."""


def read(files: Iterable[Path], column: str) -> ByCell:
    """A column of all cells that have it; a later file wins."""
    found: dict[tuple[str, str], dict[int, float]] = defaultdict(dict)
    for file in files:
        with file.open(encoding="utf-8", newline="") as stream:
            for line in csv.DictReader(stream):
                if line.get(column):
                    found[line["row"], line["sequence"]][int(line["seed"])] = float(line[column])
    return dict(found)


def alone(name: str, names: Iterable[str]) -> str | None:
    """Which of `names` a clip is made of: the longest that its name goes on from, if any."""
    return max((n for n in names if name.startswith(f"{n}_")), key=len, default=None)


def mean(figures: Iterable[float]) -> float:
    """Geometric mean; nan of nothing."""
    known = list(figures)
    return geometric_mean(known) if known else float("nan")


def times(above: BySeed, below: BySeed) -> float:
    """Ratio of geometric means over the seeds that both have; nan where they have none."""
    return mean(above[seed] / below[seed] for seed in above.keys() & below.keys())


def moving(error: ByCell, auc: ByCell) -> list[str]:
    """Rows of a table: clips with movers against those without."""
    full = {sequence: runs for (row, sequence), runs in error.items() if row == FULL}
    still = [name for name in full if (FULL, name) not in auc]
    out, ratios = [], []
    for name in full:
        other = alone(name, still) if name not in still else None
        if other is not None and full[name].keys() & full[other].keys():
            ratios.append(times(full[name], full[other]))
            least = min(auc[FULL, name].values())
            cells = [name, _list(full[name]), _list(full[other]), f"{ratios[-1]:.2f}"]
            out.append(_row([*cells, f"{least:.3f}"]))
    return [*out, _row(["geometric mean", "", "", f"{mean(ratios):.2f}", ""])]


def standing(error: ByCell, auc: ByCell) -> list[str]:
    """Rows of a table: clips without movers against the same with `uncertainty=none`."""
    out, ratios = [], []
    for (row, name), runs in error.items():
        none = error.get((NONE, name), {})
        if row == FULL and (FULL, name) not in auc and runs.keys() & none.keys():
            ratios.append(times(runs, none))
            out.append(_row([name, _list(runs), _list(none), f"{ratios[-1]:.2f}"]))
    return [*out, _row(["geometric mean", "", "", f"{mean(ratios):.2f}"])]


def _list(runs: BySeed) -> str:
    """Millimetres, by seed."""
    return " ".join(f"{1000 * runs[seed]:.3g}" for seed in sorted(runs))


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main(argv: Sequence[str] | None = None) -> None:
    """Print both tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cells", type=Path, nargs="+", help="cells.csv of an ablation")
    asked = parser.parse_args(argv)
    error, auc = read(asked.cells, "ate_rmse"), read(asked.cells, "masks.auc")
    heads = ["movers", "ATE, mm", "without, mm", "times", "least AUC"]
    print(_row(heads), _row(["---"] + ["---:"] * 4), *moving(error, auc), "", sep="\n")
    heads = ["nothing moves", "ATE, mm", "`none`, mm", "times"]
    print(_row(heads), _row(["---"] + ["---:"] * 3), *standing(error, auc), sep="\n")


if __name__ == "__main__":
    main()
