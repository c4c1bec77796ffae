"""An ablation as a file says it: rows x sequences x seeds, and what is measured."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from droidw.config.packaged import packaged_configs, packaged_in
from droidw.config.reading import Source, read_yaml
from droidw.errors import ConfigError, UsageError, did_you_mean

__all__ = ["Footage", "Layer", "Measuring", "Plan", "load_plan"]

Layer = tuple[str, Mapping[str, Any]]
"""Where a part of a configuration was written, and that part."""

# Of `vary`: what a cell is made from is no number.
_NO_NUMBERS = ("input", "input.source")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
_KEYS = (
    "title", "preset", "config", "base", "data", "sequences", "seeds", "vary", "rows",
    "columns", "measure", "needs",
)  # fmt: skip


@dataclass(frozen=True)
class Measuring:
    """How cells are measured, as the options of `droidw eval` of these names."""

    align: str = "sim3"
    normalise: str = "none"
    t_max_diff: float = 0.02
    masks_after: int = 12


@dataclass(frozen=True)
class Footage:
    """One sequence.

    Attributes:
        source: of its runs. layer: what else is set for it.
        vary: full keys that are set to the seed, beside `seed` itself: `input.skip` lets each seed
            begin a frame later, so that a spread means something where nothing draws numbers.
    """

    source: str
    layer: Layer
    vary: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """What an ablation file says.

    Attributes:
        file: as shown in messages. title: of the table.
        preset: name of the preset of all cells, or "auto".
        config: configuration files of all cells, under the layers.
        base: layer of all cells.
        sequences: name -> the sequence.
        seeds: of every row and sequence.
        rows: name -> layer; the first is what the others are compared with.
        columns: dotted names of the figures that tables show.
        measure: how cells are measured.
        needs: "cpus" and "gpus" of a cell for Ray; what is missing is found out.
    """

    file: str
    title: str
    preset: str
    config: tuple[Path, ...]
    base: Layer
    sequences: Mapping[str, Footage]
    seeds: tuple[int, ...]
    rows: Mapping[str, Layer]
    columns: tuple[str, ...] = ("ate_rmse", "masks.auc", "fps")
    measure: Measuring = field(default_factory=Measuring)
    needs: Mapping[str, float] = field(default_factory=dict)


def load_plan(
    file: str,
    data: Path | None = None,
    sequences: Sequence[str] = (),
    rows: Sequence[str] = (),
    seeds: Sequence[int] = (),
) -> Plan:
    """Read an ablation file.

    Args:
        file: path, or the name of one that comes with droidw ("cpu").
        data: folder of the sequences, instead of `data` in the file.
        sequences: these instead of those of the file; of a name that the file does not have, a
            folder of that name in `data`, or a source such as `synthetic:orbit`.
        rows: only these of the file, in its order.
        seeds: these instead of those of the file.
    Raises:
        ConfigError: the file is missing or says something that no ablation has.
        UsageError: a row that is asked for is not in the file.
    """
    path = _find(file)
    tree, lines = read_yaml(path)
    reader = _Reader(tree, lines, lines[next(iter(tree))].file if tree else str(path))
    unknown = [key for key in tree if key not in _KEYS]
    if unknown:
        raise reader.wrong(
            unknown[0],
            "no ablation has this key",
            did_you_mean(unknown[0], _KEYS) + f"keys: {', '.join(_KEYS)}\n"
            "keys of runs stand below base, sequences.NAME or rows.NAME",
        )
    plan = Plan(
        file=reader.file,
        title=str(tree.get("title") or path.stem),
        preset=_preset(reader),
        config=tuple(_config(name, path, reader) for name in reader.items("config", str, [])),
        base=(str(lines.get("base", reader.file)), reader.mapping("base")),
        sequences=_sequences(reader, data, sequences),
        # each once: the same seed twice would be one folder, and no spread
        seeds=tuple(dict.fromkeys(seeds or reader.items("seeds", int, [0]))),
        rows=reader.layers("rows"),
        columns=tuple(reader.items("columns", str, list(Plan.columns))),
        measure=reader.record("measure"),
        needs=_needs(reader),
    )
    for row in rows:
        if row not in plan.rows:
            raise UsageError(
                f"--rows: {plan.file} has no row '{row}'",
                did_you_mean(row, plan.rows) + f"rows: {', '.join(plan.rows)}",
            )
    if rows:
        kept = {name: layer for name, layer in plan.rows.items() if name in rows}
        plan = Plan(**{**plan.__dict__, "rows": kept})
    if not plan.rows or not plan.sequences or not plan.seeds:
        missing = next(n for n in ("rows", "sequences", "seeds") if not getattr(plan, n))
        raise ConfigError(f"{plan.file}: {missing}: there is none, so there is nothing to run")
    return plan


def _find(file: str) -> Path:
    path = Path(file)
    if path.is_file() or path.suffix in (".yaml", ".yml"):
        return path
    packaged = packaged_in("ablations")
    if file in packaged:
        return packaged[file]
    raise UsageError(
        f"'{file}' is neither a file nor an ablation that comes with droidw",
        did_you_mean(file, packaged) + f"available: {', '.join(packaged)}",
    )


def _preset(reader: _Reader) -> str:
    name, known = str(reader.tree.get("preset") or "auto"), [*packaged_in("presets"), "auto"]
    if name in known or name.endswith((".yaml", ".yml")):
        return name
    raise reader.wrong(
        "preset",
        f"no preset is called '{name}'",
        did_you_mean(name, known) + f"presets: {', '.join(known)}",
    )


def _config(name: str, file: Path, reader: _Reader) -> Path:
    packaged = packaged_configs()
    for candidate in (file.parent / name, packaged.get(name, file.parent / f"{name}.yaml")):
        if candidate.is_file():
            return candidate
    raise reader.wrong("config", f"there is no file or packaged config '{name}'")


def _sequences(reader: _Reader, data: Path | None, chosen: Sequence[str]) -> dict[str, Footage]:
    given = reader.tree.get("sequences") or []
    if isinstance(given, list):
        given = {str(name): {} for name in given}
        layers: dict[str, Layer] = {name: (reader.file, {}) for name in given}
        reader.check_names("sequences", given)
    else:
        layers = reader.layers("sequences")
    folder = data if data is not None else Path(str(reader.tree.get("data") or "."))
    found: dict[str, Footage] = {}
    for name in dict.fromkeys(chosen or layers):
        where, tree = layers.get(name, ("--sequences", {}))
        source = str(tree.get("source") or name)
        if ":" not in source and not Path(source).is_absolute():
            source = str(folder / source)
        rest = {key: value for key, value in tree.items() if key not in ("source", "vary")}
        full = f"sequences.{name}.vary" if "vary" in tree else "vary"
        vary = tuple(reader.names(tree.get("vary", reader.tree.get("vary", [])), full))
        for key in vary:
            if key in _NO_NUMBERS:
                raise reader.wrong(full, f"{key!r} cannot be set to a seed", "e.g. input.skip")
        found[_folder_name(name, found)] = Footage(source, (where, rest), vary)
    return found


def _folder_name(name: str, taken: Collection[str]) -> str:
    """A name of a folder of cells: a source of a reader, such as synthetic:orbit, is none itself.

    Names stay apart of which only that is left which is alike: `my clip` and `my-clip`.
    """
    plain = re.sub(r"[^A-Za-z0-9._+-]", "-", name)
    if _NAME.fullmatch(plain) and plain not in taken:
        return plain
    mark = hashlib.sha256(name.encode()).hexdigest()[:6]
    return f"{plain.lstrip('._+-') or 'sequence'}-{mark}"


def _needs(reader: _Reader) -> dict[str, float]:
    found = {}
    for key, value in reader.mapping("needs").items():
        usable = isinstance(value, (int, float)) and not isinstance(value, bool) and value >= 0
        if key not in ("cpus", "gpus") or not usable:
            raise reader.wrong(f"needs.{key}", "a cell needs a number of `cpus` and of `gpus`")
        found[key] = float(value)
    return found


class _Reader:
    """Values of the file with their types, and errors that say the line."""

    def __init__(self, tree: Mapping[str, Any], lines: Mapping[str, Source], file: str) -> None:
        self.tree, self.lines, self.file = tree, lines, file

    def wrong(self, key: str, said: str, hint: str = "") -> ConfigError:
        return ConfigError(f"{self.lines.get(key, self.file)}: {key}: {said}", hint)

    def mapping(self, key: str) -> dict[str, Any]:
        value = self.tree.get(key)
        if value is not None and not isinstance(value, dict):
            raise self.wrong(key, f"{value!r} is no mapping of keys to values")
        return dict(value or {})

    def check_names(self, key: str, names: Mapping[str, Any]) -> None:
        for name in names:
            if not _NAME.fullmatch(name):
                raise self.wrong(
                    f"{key}.{name}",
                    f"'{name}' cannot be the name of a folder",
                    "letters, digits and . _ + - are valid",
                )

    def layers(self, key: str) -> dict[str, Layer]:
        found: dict[str, Layer] = {}
        self.check_names(key, self.mapping(key))
        for name, value in self.mapping(key).items():
            full = f"{key}.{name}"
            if value is not None and not isinstance(value, dict):
                raise self.wrong(full, f"{value!r} is no mapping; {{}} changes nothing")
            where = self.lines.get(full)
            found[name] = (f"{where or self.file}: {full}", value or {})
        return found

    def names(self, value: Any, key: str) -> list[str]:
        return self._list(value, key, str)

    def items(self, key: str, kind: type, default: list[Any]) -> list[Any]:
        return self._list(self.tree.get(key, default), key, kind)

    def _list(self, value: Any, key: str, kind: type) -> list[Any]:
        value = [value] if isinstance(value, kind) else value
        bad = not isinstance(value, list) or not all(
            isinstance(item, kind) and not isinstance(item, bool) for item in value
        )
        if bad:
            word = {"str": "names", "int": "whole numbers"}[kind.__name__]
            raise self.wrong(key, f"{value!r} is no list of {word}")
        return list(value)

    def record(self, key: str) -> Measuring:
        given = self.mapping(key)
        defaults = Measuring()
        choices = {
            "align": ("sim3", "se3", "scale", "none"),
            "normalise": ("none", "displacement", "path"),
        }
        for name, value in given.items():
            full = f"{key}.{name}"
            if name not in defaults.__dict__:
                raise self.wrong(
                    full, "there is no such key", f"keys: {', '.join(defaults.__dict__)}"
                )
            if name in choices and value not in choices[name]:
                raise self.wrong(
                    full, f"{value!r} is not valid", f"valid: {', '.join(choices[name])}"
                )
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            whole = name != "masks_after" or isinstance(value, int)
            if name not in choices and not (number and whole and 0 <= value < math.inf):
                raise self.wrong(full, f"{value!r} is not a number from 0")
        return Measuring(**given)
