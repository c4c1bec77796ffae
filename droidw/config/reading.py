"""YAML as plain values, with the line of every key."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from droidw.errors import ConfigError

__all__ = ["NO_VALUE", "YAML_LOADER", "Builder", "Source", "read_yaml", "shown", "written"]

YAML_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""Written in C where PyYAML has it: an ablation reads its files once for every row."""

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)")
_NAMES = re.compile(
    r"(?:.+\.)?(?:input\.(?:source|masks)|camera\.calib)|data|sequences(?:\.[^.]+(?:\.source)?)?"
)
"""Keys of files and footage, whose names may be digits: 010 is no number there."""

NO_VALUE = (yaml.YAMLError, ValueError, RecursionError)
"""What reading a value may raise."""
_Tree = dict[str, Any]


@dataclass(frozen=True)
class Source:
    """Where a value was written: a file and its line (0: unknown), or the command line."""

    file: str
    line: int = 0

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


def shown(path: Path) -> str:
    """A path as short as it can be told: relative to where the user stands."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def read_yaml(path: Path) -> tuple[_Tree, dict[str, Source]]:
    """The mapping in a YAML file, and where each full key is written.

    Numbers such as 1e-3 are numbers, and a key that is written twice is refused.

    Raises:
        ConfigError: the file cannot be read, or holds no mapping.
    """
    name = shown(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"{name}: there is no such configuration file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{name}: cannot be read: {error}") from error
    try:
        node = yaml.compose(text, Loader=YAML_LOADER)
    except yaml.YAMLError as error:
        raise ConfigError(f"{name}: is not YAML: " + " ".join(str(error).split())) from error
    if node is None:
        return {}, {}
    if not isinstance(node, yaml.MappingNode):
        raise ConfigError(f"{name}: a configuration holds `key: value` lines, not a bare value")
    builder = Builder(name)
    try:
        return builder.value(node, ""), builder.lines
    except NO_VALUE as error:
        last = next(reversed(builder.lines.values()), None)
        told = " ".join(str(error).split())
        raise ConfigError(f"{last or name}: holds what is no value: {told}") from error


class Builder:
    """Plain values out of YAML nodes, noting the line of every key; doubled keys are refused."""

    def __init__(self, shown: str) -> None:
        self.shown = shown
        self.lines: dict[str, Source] = {}
        self._loader = yaml.SafeLoader("")

    def value(self, node: yaml.Node, prefix: str) -> Any:
        """The value of a node whose full key is `prefix`."""
        if _NAMES.fullmatch(prefix) and (names := _as_written(node)) is not None:
            return names
        if not isinstance(node, yaml.MappingNode):
            value = self._loader.construct_object(node, deep=True)
            # YAML 1.1 takes 1e-3 for text
            plain = isinstance(node, yaml.ScalarNode) and not node.style
            if plain and isinstance(value, str) and _NUMBER.fullmatch(value):
                return float(value)
            return value
        tree: _Tree = {}
        for key_node, value_node in node.value:
            key = str(key_node.value)
            full = f"{prefix}.{key}" if prefix else key
            source = Source(self.shown, key_node.start_mark.line + 1)
            if key in tree:
                raise ConfigError(f"{source}: {full}: is written twice in this file")
            self.lines[full] = source
            tree[key] = self.value(value_node, full)
        return tree


def _as_written(node: yaml.Node) -> str | list[str] | None:
    """The text of a scalar, or those of a list of them; None for anything else, and for null."""
    if isinstance(node, yaml.ScalarNode):
        return None if node.tag.endswith(":null") else str(node.value)
    if isinstance(node, yaml.SequenceNode):
        texts = [_as_written(one) for one in node.value]
        known = [text for text in texts if isinstance(text, str)]
        return known if len(known) == len(texts) else None
    return None


def written(value: Any) -> str:
    """A value as it would stand in a YAML file."""
    return str(yaml.safe_dump(value, default_flow_style=True)).removesuffix("...\n").strip()
