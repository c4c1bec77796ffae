"""The cells of an ablation: one configuration each, a folder each, and what came of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from droidw.ablation.plan import Footage, Layer, Measuring, Plan
from droidw.config.load import load_config, override_layers
from droidw.config.reading import YAML_LOADER
from droidw.config.resolve import ResolvedConfig, choose_preset, resolve
from droidw.errors import (
    ConfigError,
    DroidwError,
    InputError,
    MissingRequirementError,
    PluginError,
)
from droidw.io.dataset_tables import data_root, split_source, table_names
from droidw.io.files import write_json, write_text

if TYPE_CHECKING:
    from droidw.plugin.manager import Plugins

__all__ = ["Cell", "Outcome", "forget", "make_cells", "prepare", "read_outcome", "take"]

_PREPARED = ("cell.yaml", "cell.json")

# Written in C where PyYAML has it: there is a configuration for every cell.
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

_QUICK: Layer = (
    "ablation",
    {
        # One thread: cells run side by side, and the same numbers come out whatever their number.
        "threads": 1,
        "exporters": {
            "ply": None, "depth": None, "uncertainty": {"video": False, "masks": False},
        },
        "observers": {"progress": None, "report": None},
    },
)  # fmt: skip
"""What a cell does unless the file says otherwise: it writes what is measured, and no more."""


@dataclass(frozen=True)
class Cell:
    """One row on one sequence with one seed.

    Attributes:
        row, sequence, seed: its place in the table.
        config: the resolved configuration as YAML.
        missing: why it cannot run on this machine, or "".
        threads: of torch and of workers. gpus: how many it wants.
        beside: what its result depends on besides, as text.
    """

    row: str
    sequence: str
    seed: int
    config: str
    missing: str = ""
    threads: int = 1
    gpus: float = 0
    beside: str = ""

    @property
    def name(self) -> str:
        """Its folder below `cells/`."""
        return f"{self.row}/{self.sequence}/seed-{self.seed}"

    @property
    def digest(self) -> str:
        """What its result depends on, as a hash; comments in the configuration do not count."""
        lines = [line for line in self.config.splitlines() if not line.startswith("#")]
        lines += [self.beside] if self.beside else []
        return hashlib.sha256("\n".join(lines).encode("utf-8")).hexdigest()


@dataclass(frozen=True)
class Outcome:
    """What came of a cell.

    Attributes:
        metrics: figures by dotted name, those that exist.
        facts: device, versions and so on.
        curve: path and errors for plots, or empty.
        error: why there are no figures, or "".
        code: exit code of a cell that failed.
        seconds: how long its process took.
    """

    metrics: Mapping[str, float]
    facts: Mapping[str, Any]
    curve: Mapping[str, Any]
    error: str = ""
    code: int = 0
    seconds: float = 0.0


def make_cells(
    plan: Plan,
    plugins: Plugins,
    overrides: Sequence[str] = (),
    preset: str | None = None,
    *,
    plugin_files: Sequence[str] = (),
    data: Path | None = None,
) -> tuple[list[Cell], str]:
    """Resolve every cell, so that a mistake in the last row shows before the first one runs.

    From weak to strong: preset, `config` files, `base`, the sequence, overrides, the row, the seed
    and what varies with it.

    Args:
        plugin_files, data: as of `prepare`. Where a file changes (itself, not what it imports), or
            the folder in which a dataset lies, finished cells run again.
    Returns:
        Cells, row by row, and why a preset was chosen (or "").
    Raises:
        ConfigError, UsageError: a row, sequence or override is refused.
        PluginNotFound: a row names a plugin that is not there.
        InputError: a sequence is not there.
        MissingRequirementError: no cell at all can run on this machine.
    """
    chosen, note = preset or plan.preset, ""
    if chosen == "auto":
        chosen, note = choose_preset(plugins)
    _check_sources(plan)
    said = override_layers(overrides)
    files = [hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in plugin_files]
    first = next(iter(plan.rows), "")
    failed: DroidwError | None = None
    known: dict[str, Cell] = {}
    cells: list[Cell] = []
    for row, row_layer in plan.rows.items():
        for sequence, footage in plan.sequences.items():
            # Resolving takes a while, and sequences and seeds often differ in values alone.
            # But for what their dataset says of them.
            named = footage.source if _in_a_dataset(footage.source) else ""
            there = [str(_folder(data or data_root()))] if named else []
            beside = "\n".join([*files, *there])
            same = json.dumps([row, footage.layer[1], footage.vary, named], default=str)
            if same not in known:
                # Resolving takes a while: what the first row takes of other seeds, others will.
                seeds = plan.seeds if row == first and footage.vary else plan.seeds[:1]
                layers = (_QUICK, plan.base, footage.layer, *said, row_layer)
                _refuse_taken(layers, footage)
                for seed in reversed(seeds):
                    varied = _varied(plan, footage, seed)
                    loaded = load_config(plan.config, chosen, (), None, (*layers, *varied))
                    try:
                        known[same] = _cell(row, sequence, resolve(loaded, plugins), plan)
                    except (MissingRequirementError, PluginError) as error:
                        text = yaml.safe_dump(loaded.data, sort_keys=False)
                        known[same] = Cell(row, sequence, 0, text, missing=error.message)
                        failed = failed or error
            for seed in plan.seeds:
                values = {"seed": seed, "input.source": _place(footage.source)}
                values |= dict.fromkeys(footage.vary, seed)
                config = _with(known[same].config, values)
                cell = replace(known[same], sequence=sequence, seed=seed, config=config)
                cells.append(replace(cell, beside=beside))
    if failed is not None and all(cell.missing for cell in known.values()):
        raise failed
    return cells, note


def _varied(plan: Plan, footage: Footage, seed: int) -> Iterator[Layer]:
    """Layers of one seed, and of what varies with it."""
    yield "ablation", {"input": {"source": _place(footage.source)}}
    yield f"{plan.file}: seeds", {"seed": seed}
    for key in footage.vary:
        value: Any = seed
        for name in reversed(key.split(".")):
            value = {name: value}
        yield f"{plan.file}: vary", value


def _refuse_taken(layers: Sequence[Layer], footage: Footage) -> None:
    """Refuse what every cell has of its own: set once more, it would change nothing.

    Raises:
        ConfigError: with the layer that sets it.
    """
    hints = dict.fromkeys(footage.vary, "it is in `vary`, so that each seed has its own")
    hints |= {
        "seed": "each cell has one of `seeds` in the file, or of --seeds",
        "input.source": "each cell has that of its sequence: `sequences` in the file, --sequences",
    }
    for where, tree in layers:
        given = tree.get("input")
        if given is not None and not isinstance(given, Mapping):
            raise ConfigError(f"{where}: input: {given!r} is no section", "e.g. input: {skip: 3}")
        for key, hint in hints.items():
            part: Any = tree
            for name in key.split("."):
                part = part.get(name) if isinstance(part, Mapping) else None
            if part is not None:
                raise ConfigError(f"{where}: {key} cannot be set for cells", hint)


def _place(source: str) -> str:
    return source if ":" in source else str(Path(source).resolve())


def _in_a_dataset(source: str) -> bool:
    parted = split_source(source)
    return parted is not None and parted[0] in table_names()


def _folder(data: Path) -> Path:
    return data.expanduser().resolve()


def _with(text: str, values: Mapping[str, Any]) -> str:
    """A resolved configuration with other values of these full keys."""
    tree = yaml.load(text, Loader=YAML_LOADER)
    for key, value in values.items():
        *path, last = key.split(".")
        part = tree
        for name in path:
            part = part[name]
        part[last] = value
    head = [line for line in text.splitlines() if line.startswith("#")]
    body = yaml.dump(tree, Dumper=_DUMPER, sort_keys=False, allow_unicode=True)
    return "\n".join([*head, str(body)])


def _cell(row: str, sequence: str, resolved: ResolvedConfig, plan: Plan) -> Cell:
    gpus = plan.needs.get("gpus")
    if gpus is None:
        gpus = float(_wants_gpu(resolved))
    threads = max(1, resolved.config.threads)
    return Cell(row, sequence, 0, resolved.to_yaml(), threads=threads, gpus=gpus)


def _wants_gpu(resolved: ResolvedConfig) -> bool:
    device = resolved.config.device
    if device != "auto":
        return device.startswith("cuda")
    if not resolved.suits_gpu:
        return False
    import torch

    return torch.cuda.is_available()


def _check_sources(plan: Plan) -> None:
    gone = [
        f"{name} ({footage.source})"
        for name, footage in plan.sequences.items()
        if ":" not in footage.source and not Path(footage.source).exists()
    ]
    if gone:
        raise InputError(
            f"{plan.file}: of {len(plan.sequences)} sequences, {len(gone)} are not there: "
            + ", ".join(gone),
            "say where they are: --data DIR; or choose others: --sequences NAME,NAME",
        )


def prepare(
    cell: Cell,
    folder: Path,
    measure: Measuring,
    plugin_files: Sequence[str] = (),
    data: Path | None = None,
) -> None:
    """Write what the process of a cell reads, `cell.yaml` and `cell.json`, until it takes them.

    Until then the folder keeps what an earlier call left: files and results go together.

    Args:
        cell: what is run. folder: of the cell. measure: how it is measured.
        plugin_files: as given with --plugin. data: folder of datasets, or None for the usual one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / _waiting("cell.yaml"), cell.config)
    spec = {
        "row": cell.row,
        "sequence": cell.sequence,
        "seed": cell.seed,
        "digest": cell.digest,
        "threads": cell.threads,
        "plugins": [str(Path(file).resolve()) for file in plugin_files],
        "data": None if data is None else str(_folder(data)),
        "folder": str(Path.cwd()),
        "measure": asdict(measure),
    }
    write_json(folder / _waiting("cell.json"), spec)


def take(folder: Path) -> dict[str, Any]:
    """Give up what came of a cell earlier, and take what has been prepared; returns `cell.json`."""
    for name in ("result.json", "failure.json"):
        (folder / name).unlink(missing_ok=True)
    for name in _PREPARED:
        with suppress(FileNotFoundError):  # taken before: the cell is tried once more
            (folder / _waiting(name)).replace(folder / name)
    spec: dict[str, Any] = json.loads((folder / "cell.json").read_text(encoding="utf-8"))
    return spec


def forget(folder: Path) -> None:
    """Remove what has been prepared for a cell that was not started."""
    for name in _PREPARED:
        (folder / _waiting(name)).unlink(missing_ok=True)


def _waiting(name: str) -> str:
    return f".{name}.waiting"


def read_outcome(cell: Cell, folder: Path, measure: Measuring) -> Outcome | None:
    """What came of a cell earlier, or None if it has to run (again).

    A finished cell whose configuration is another now has to; one that is only to be measured
    differently is measured again from its files, if they are still there.
    """
    record = _read(folder / "result.json")
    if record is not None and record.get("digest") == cell.digest:
        if record.get("measure") != asdict(measure):
            if not (folder / "run" / "manifest.json").is_file():
                return None
            from droidw.ablation.measure import measure_run

            record.update(measure_run(folder / "run", measure), measure=asdict(measure))
            write_json(folder / "result.json", record)
        return Outcome(
            record["metrics"], record["facts"], record["curve"], seconds=record.get("seconds", 0.0)
        )
    return None


def _read(path: Path) -> dict[str, Any] | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) else None
