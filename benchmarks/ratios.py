"""What moving things cost: cells of `droidw ablate` over those of the same clip without movers.

    python benchmarks/ratios.py runs/ablations/unseen/cells.csv [MORE.csv ...] [--save NAME]

A clip with movers is called as the one without, an underscore, and what moves: `room4_camel` is
held against `room4`. Means over seeds are geometric, and so are those over clips. Where there is a
row `no-uncertainty`, all clips are held against that as well. `--save` also writes
`results/NAME.md`.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import geometric_mean

from end_to_end import RESULTS, machine, today

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
    return [*out, _row(["geometric mean", "", "", f"{mean(ratios):.2f}", ""])] if out else []


def standing(error: ByCell, auc: ByCell) -> list[str]:
    """Rows of a table: clips without movers against the same with `uncertainty=none`."""
    out, ratios = [], []
    for (row, name), runs in error.items():
        none = error.get((NONE, name), {})
        if row == FULL and (FULL, name) not in auc and runs.keys() & none.keys():
            ratios.append(times(runs, none))
            out.append(_row([name, _list(runs), _list(none), f"{ratios[-1]:.2f}"]))
    return [*out, _row(["geometric mean", "", "", f"{mean(ratios):.2f}"])] if out else []


def trusted(error: ByCell, auc: ByCell) -> list[str]:
    """Rows of a table: clips with movers against the same with `uncertainty=none`."""
    full = {sequence: runs for (row, sequence), runs in error.items() if row == FULL}
    still = [name for name in full if (FULL, name) not in auc]
    out = []
    for name, runs in full.items():
        none, other = error.get((NONE, name), {}), alone(name, still)
        if name not in still and other is not None and runs.keys() & none.keys():
            ratios = times(none, full[other]), times(runs, none)
            out.append(_row([name, _list(runs), _list(none), *(f"{r:.3g}" for r in ratios)]))
    return out


def masks(auc: ByCell) -> list[str]:
    """Rows of a table: uncertainty against motion masks, the least of all seeds."""
    return [_row([n, f"{min(r.values()):.3f}"]) for (row, n), r in auc.items() if row == FULL]


def _list(runs: BySeed) -> str:
    """Millimetres, by seed."""
    return " ".join(f"{1000 * runs[seed]:.3g}" for seed in sorted(runs))


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def tables(error: ByCell, auc: ByCell) -> str:
    """All tables as Markdown, but for those that would be empty."""
    parts = [
        (["movers", "ATE, mm", "without, mm", "times", "least AUC"], moving(error, auc)),
        (
            ["movers", "ATE, mm", "`none`, mm", "`none` over static", "of `none`"],
            trusted(error, auc),
        ),
        (["nothing moves", "ATE, mm", "`none`, mm", "times"], standing(error, auc)),
        (["masks", "least AUC"], masks(auc)),
    ]
    return "\n\n".join(
        "\n".join([_row(heads), _row(["---"] + ["---:"] * (len(heads) - 1)), *rows])
        for heads, rows in parts
        if rows
    )


def save(name: str, text: str) -> Path:
    """Tables, machine and date into `results/`; returns the file."""
    facts = [_row([key, str(value)]) for key, value in machine().items()]
    made = f"{today()}, made by `python benchmarks/ratios.py`; millimetres, ATE RMSE of all frames."
    path = RESULTS / f"{name}.md"
    lines = [f"# {name}", "", made, "", text, "", "| | |", "|---|---|", *facts]
    path.write_text("\n".join(lines) + "\n")
    return path


def main(argv: Sequence[str] | None = None) -> None:
    """Print the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cells", type=Path, nargs="+", help="cells.csv of an ablation")
    parser.add_argument("--save", metavar="NAME", help=f"also write into {RESULTS.name}/")
    asked = parser.parse_args(argv)
    text = tables(read(asked.cells, "ate_rmse"), read(asked.cells, "masks.auc"))
    print(text)
    if asked.save:
        print(f"saved: {save(asked.save, text)}", file=sys.stderr)


if __name__ == "__main__":
    main()
