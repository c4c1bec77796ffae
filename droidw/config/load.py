"""Configuration files and overrides merged into one tree that remembers where each key is from.

Layers, each beating the ones before: schema defaults, the preset, what a file `extends`, the
file, the command line. Names of plugins are only resolved later (`droidw.config.resolve`).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from droidw.config.packaged import packaged_configs, packaged_in
from droidw.config.reading import (
    NO_VALUE,
    YAML_LOADER,
    Builder,
    Source,
    read_yaml,
    shown,
    written,
)
from droidw.config.schema import DroidwConfig
from droidw.errors import ConfigError, UsageError, did_you_mean
from droidw.plugin.registry import SLOTS

__all__ = [
    "LISTED",
    "LoadedConfig",
    "load_config",
    "override_layers",
]

LISTED = ("exporters", "observers")
"""Keys that map names of plugins to their options, any number at a time."""

COMMAND_LINE = "command line"
_Tree = dict[str, Any]


@dataclass(frozen=True)
class LoadedConfig:
    """Merged layers, not yet checked.

    Attributes:
        data: the tree, with every default in it; slots are `{name, options}`.
        sources: full key -> where it was set; keys at their default are absent.
        files: every file read, in the order of merging.
        preset: name of the preset, or None.
    """

    data: _Tree
    sources: Mapping[str, Source] = field(default_factory=dict)
    files: tuple[str, ...] = ()
    preset: str | None = None

    def source(self, key: str) -> Source | None:
        """Where a key, or else the nearest section around it, or anything in it, was set."""
        around = key
        while around:
            if around in self.sources:
                return self.sources[around]
            around = around.rpartition(".")[0]
        return next((s for k, s in self.sources.items() if k.startswith(key + ".")), None)

    def at(self, key: str) -> str:
        """The start of a message about a key: "my.yaml:3: camera.fov"."""
        source = self.source(key)
        return key if source is None else f"{source}: {key}"


def load_config(
    files: Sequence[str | Path] = (),
    preset: str | None = None,
    overrides: Sequence[str] = (),
    values: Mapping[str, Any] | None = None,
    layers: Sequence[tuple[str, Mapping[str, Any]]] = (),
) -> LoadedConfig:
    """Read and merge, without looking at any plugin.

    Args:
        files: YAML files, later ones beat earlier ones.
        preset: name of a packaged preset, or the path of a file used as one.
        overrides: `key=value` as typed, the value read as YAML. Choices of a plugin take effect
            before the options in the same list, in whatever order they were typed.
        values: full key -> value, as flags such as `--stride` give them.
        layers: where from -> tree as in a file; merged last, in this order.
    A source such as `bonn:balloon` brings the settings of its dataset along, just above the
    preset, where `configs/datasets` names that preset.

    Raises:
        ConfigError: a file is missing, is no YAML, extends itself, or a slot holds no name.
        UsageError: an override is not `key=value`, or there is no such preset.
    """
    said = [_nested(key.split("."), value) for key, value in (values or {}).items()]
    last = [*override_layers(overrides, said), *layers]

    def merged(source: str) -> _Merger:
        merger = _Merger()
        if preset is not None:
            merger.add_file(_preset_path(preset), ())
        merger.add_dataset(source, preset)
        for file in files:
            merger.add_file(Path(file), ())
        for where, layer in last:
            merger.merge(merger.data, layer, "", {"": Source(where)})
        return merger

    merger = merged("")
    given = merger.data["input"]  # whatever is no section is refused later on, with its line
    source = given.get("source") if isinstance(given, Mapping) else None
    if preset is not None and isinstance(source, str) and ":" in source:
        merger = merged(source)
    return LoadedConfig(merger.data, merger.sources, tuple(merger.files), preset)


def override_layers(
    overrides: Sequence[str], trees: Sequence[Mapping[str, Any]] = ()
) -> list[tuple[str, Mapping[str, Any]]]:
    """Overrides as typed (`key=value`), and more trees, as layers in the order of merging.

    Raises:
        UsageError: an override is not `key=value`.
    """
    said = [*trees, *(_nested(*_override(text)) for text in overrides)]
    return [(COMMAND_LINE, tree) for tree in sorted(said, key=lambda tree: not _chooses(tree))]


# A date that is none, a tag that nobody knows, an alias of what it is part of.


class _Merger:
    """The tree under construction, with the source of each key."""

    def __init__(self) -> None:
        self.data: _Tree = dataclasses.asdict(DroidwConfig())
        self.sources: dict[str, Source] = {}
        self.files: list[str] = []

    def add_file(self, path: Path, stack: tuple[Path, ...]) -> None:
        """Merge what a file extends, then the file."""
        real = path.resolve()
        if real in stack:
            chain = " -> ".join(p.name for p in (*stack[stack.index(real) :], real))
            raise ConfigError(f"{shown(path)}: extends: the files extend each other: {chain}")
        tree, lines = read_yaml(path)
        extends = tree.pop("extends", [])
        names = [extends] if isinstance(extends, str) else extends
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ConfigError(
                f"{lines['extends']}: extends: {extends!r} is neither a name nor a list of names",
                "example: extends: [presets/cpu, datasets/bonn]",
            )
        for name in names:
            self.add_file(_extended(name, path, lines["extends"]), (*stack, real))
        if _is_table(tree.get("dataset")):  # for readers and `droidw data`, no setting of a run
            del tree["dataset"]
        self.files.append(shown(path))
        self.merge(self.data, tree, "", {"": Source(shown(path)), **lines})

    def add_dataset(self, source: str, preset: str | None) -> None:
        """Merge the settings of the dataset, and of the sequence, that a source names."""
        dataset, _, name = source.partition(":")
        path = packaged_configs().get(f"datasets/{dataset}") if name else None
        if path is None:
            return
        tree, lines = read_yaml(path)
        table = tree.pop("dataset", None)
        if not _is_table(table) or preset not in table.get("presets", []):
            return
        file = shown(path)
        self.files.append(file)
        self.merge(self.data, tree, "", {"": Source(file), **lines})
        for key, row in table["sequences"].items():
            if row and name in (key, *row.get("also", ())):
                at = lines.get(f"dataset.sequences.{key}", Source(file))
                self.merge(self.data, row.get("run", {}), "", {"": at})

    def merge(
        self, base: _Tree, layer: Mapping[str, Any], prefix: str, lines: Mapping[str, Source]
    ) -> None:
        """Merge a layer into the part of the tree below `prefix`."""
        for key, value in layer.items():
            full = f"{prefix}.{key}" if prefix else key
            if full in SLOTS:
                self._merge_slot(full, value, lines)
            elif full in LISTED and isinstance(value, list):
                self._replace(base, key, {str(name): {} for name in value}, full, lines)
            elif isinstance(value, Mapping) and isinstance(base.get(key), dict):
                self.merge(base[key], value, full, lines)
            elif value is None and isinstance(base.get(key), dict) and prefix not in LISTED:
                continue  # a section whose keys are all commented out
            else:
                self._replace(base, key, value, full, lines)

    def _replace(
        self, base: _Tree, key: str, value: Any, full: str, lines: Mapping[str, Source]
    ) -> None:
        self._forget(full)
        base[key] = copy.deepcopy(value)
        self.sources[full] = lines.get(full, lines[""])
        for below, source in lines.items():
            if below.startswith(full + "."):
                self.sources[below] = source

    def _merge_slot(self, slot: str, value: Any, lines: Mapping[str, Source]) -> None:
        """`uncertainty: mlp` is `{name: mlp}`; another name than before drops the options."""
        where = lines.get(slot, lines[""])
        value = {"name": value} if isinstance(value, str) else value
        if not isinstance(value, Mapping):
            raise ConfigError(
                f"{where}: {slot}: {written(value)} is not the name of a plugin",
                f"write {slot}: NAME, or {slot}: {{name: NAME, options: {{...}}}}; "
                "what is to be off is called none\n"
                f"see: droidw list-plugins --kind {slot}",
            )
        given = dict(value)
        current: _Tree = self.data[slot]
        if "name" in given:
            name = given.pop("name")
            name_source = lines.get(f"{slot}.name", where)
            if not isinstance(name, str):
                raise ConfigError(
                    f"{name_source}: {slot}.name: {written(name)} is not the name of a plugin",
                    f"see: droidw list-plugins --kind {slot}",
                )
            if name != current["name"]:
                self._forget(slot)
                current = self.data[slot] = {"name": name, "options": {}}
            self.sources[f"{slot}.name"] = name_source
        self.merge(current, given, slot, lines)

    def _forget(self, full: str) -> None:
        for key in [k for k in self.sources if k == full or k.startswith(full + ".")]:
            del self.sources[key]


def _is_table(tree: Any) -> bool:
    """Whether this is the table of a dataset (`droidw.io.dataset_tables`)."""
    return isinstance(tree, Mapping) and isinstance(tree.get("sequences"), Mapping)


def _chooses(layer: Mapping[str, Any]) -> bool:
    """Whether an override names a plugin, and so must come before that plugin's options."""
    slot, value = next(iter(layer.items()))
    return slot in SLOTS and (not isinstance(value, dict) or "name" in value)


def _override(text: str) -> tuple[list[str], Any]:
    key, equals, value = text.partition("=")
    path = key.strip().split(".")
    if not equals or not all(path):
        raise UsageError(
            f"{COMMAND_LINE}: '{text}' is not key=value",
            "example: camera.long_side=512   or   uncertainty=none",
        )
    try:
        node = yaml.compose(value, Loader=YAML_LOADER)
        found = None if node is None else Builder(COMMAND_LINE).value(node, key.strip())
    except NO_VALUE as error:
        raise UsageError(
            f"{COMMAND_LINE}: {key}: the value {value!r} is not YAML: "
            + " ".join(str(error).split()),
            "quote it for the shell and for YAML, for example: 'input.source=\"a: b\"'",
        ) from error
    # In a file that may be a list whose lines are all commented out; typed it means none of them.
    return path, found if found or key.strip() not in LISTED else []


def _nested(path: Sequence[str], value: Any) -> _Tree:
    for key in reversed(path):
        value = {key: value}
    return dict(value)


def _preset_path(preset: str) -> Path:
    if preset.endswith((".yaml", ".yml")):
        return Path(preset)
    presets = packaged_in("presets")
    if preset in presets:
        return presets[preset]
    raise UsageError(
        f"--preset: no preset is called '{preset}'",
        did_you_mean(preset, presets) + f"presets: {', '.join(presets)}, auto",
    )


def _extended(name: str, file: Path, where: Source) -> Path:
    """The file that `extends` means: packaged by its name, or relative to the file."""
    packaged = packaged_configs()
    beside = file.parent / name
    if name in packaged and not beside.is_file():
        return packaged[name]
    for candidate in (beside, beside.with_name(beside.name + ".yaml")):
        if candidate.is_file():
            return candidate
    raise ConfigError(
        f"{where}: extends: there is no file or packaged config '{name}'",
        did_you_mean(name, packaged)
        + f"packaged: {', '.join(packaged)}\nor a path relative to {file.parent or '.'}",
    )
