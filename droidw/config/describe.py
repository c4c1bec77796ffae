"""The schema in words: types and ranges for messages, tables for docs, a commented base file."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Union

import yaml

from droidw.config.inert import INERT
from droidw.config.plain import plain
from droidw.config.schema import DroidwConfig
from droidw.plugin.registry import KINDS

__all__ = ["Row", "base_yaml", "limits_text", "markdown", "rows", "type_text", "within"]

_SIGNS = (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))
_WORDS = {int: "whole number", float: "number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class Row:
    """One key of a configuration: full key, type, default as YAML, limits, help."""

    key: str
    type: str
    default: str
    limits: str
    help: str


def rows(cls: type, prefix: str = "", instance: Any = None) -> Iterator[Row]:
    """Every key of a dataclass of options, nested ones with their full key.

    Args:
        cls: a dataclass in which every field has a default.
        prefix: full key of the section, or "".
        instance: holds the defaults, if they are not those of the class.
    """
    hints = typing.get_type_hints(cls)
    instance = cls() if instance is None else instance
    for entry in dataclasses.fields(cls):
        value = getattr(instance, entry.name)
        key = f"{prefix}.{entry.name}" if prefix else entry.name
        if dataclasses.is_dataclass(value):
            if prefix or entry.name not in KINDS:
                yield from rows(type(value), key, value)
            else:
                noun = KINDS[entry.name].noun
                name = str(getattr(value, "name", ""))
                yield Row(key, "plugin", name, "", f"the {noun}: a name, or name and options")
        elif isinstance(value, dict) and any(map(dataclasses.is_dataclass, value.values())):
            for name, item in value.items():
                yield from rows(type(item), f"{key}.{name}", item)
        else:
            yield Row(
                key,
                type_text(hints[entry.name]),
                _flow(value),
                limits_text(entry.metadata),
                f"no effect: {INERT[key]}" if key in INERT else entry.metadata.get("help", ""),
            )


def type_text(hint: Any) -> str:
    """A type in words: "whole number", "one of rational, inverse, none", "list of text"."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return "one of " + ", ".join(map(str, args))
    if origin in (Union, types.UnionType):
        return " or ".join("null" if a is type(None) else type_text(a) for a in args)
    if origin in (list, tuple):
        return f"list of {type_text(args[0])}s".replace("texts", "text") if args else "list"
    if origin is dict or hint is dict:
        return "mapping"
    return _WORDS.get(hint, getattr(hint, "__name__", str(hint)))


def limits_text(metadata: Mapping[str, Any]) -> str:
    """The limits of a key, e.g. "> 1 and < 179", or ""."""
    return " and ".join(f"{sign} {metadata[name]}" for name, sign in _SIGNS if name in metadata)


def within(value: float, metadata: Mapping[str, Any]) -> bool:
    """Whether a number keeps the limits; NaN keeps none."""
    return (
        value >= metadata.get("ge", float("-inf"))
        and value <= metadata.get("le", float("inf"))
        and ("gt" not in metadata or value > metadata["gt"])
        and ("lt" not in metadata or value < metadata["lt"])
    )


def markdown(cls: type = DroidwConfig) -> str:
    """The page `docs/configuration.md`: one table per section."""
    lines = [
        "# Configuration",
        "",
        "Every key, its default (those of preset `cpu`) and what it means. Generated from",
        "`droidw/config/schema.py` by `python -m droidw.config.describe`.",
        "",
        "Layers, each beating the ones before: these defaults, `--preset`, what a file `extends`,",
        "the file, the command line (`key=value`). A part is chosen by its name",
        "(`uncertainty=none`); choosing another part drops the options of the one before. The",
        "options of each part: `droidw list-plugins --options NAME`.",
    ]
    section = None
    for row in rows(cls):
        head = row.key.rpartition(".")[0] or "parts and run"
        if head != section:
            section = head
            lines += [
                "",
                f"## {head}",
                "",
                "| key | type | default | range | meaning |",
                "|---|---|---|---|---|",
            ]
        cells = (f"`{row.key}`", row.type, f"`{row.default}`", row.limits, row.help)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def base_yaml(cls: type = DroidwConfig) -> str:
    """`configs/base.yaml`: every default as a file that may be extended, commented."""
    lines = [
        "# Every key with its default and what it means. Generated from droidw/config/schema.py",
        "# by `python -m droidw.config.describe`; these values hold without this file.",
    ]
    seen: list[str] = []
    for row in rows(cls):
        *sections, name = row.key.split(".")
        common = 0
        while common < min(len(sections), len(seen)) and sections[common] == seen[common]:
            common += 1
        if seen != sections and (not common or not sections):
            lines.append("")
        for depth in range(common, len(sections)):
            lines.append("  " * depth + sections[depth] + ":")
        seen = sections
        limits = f" ({row.limits})" if row.limits else ""
        default = row.default
        lines.append("  " * len(sections) + f"{name}: {default}  # {row.help}{limits}".rstrip())
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    text = str(yaml.safe_dump(plain(value), default_flow_style=True, width=10_000, sort_keys=False))
    return text.removesuffix("\n...\n").strip()


def _write() -> None:
    """Write both generated files into the source tree that this module lies in."""
    from pathlib import Path

    root = Path(__file__).resolve().parents[2]
    (root / "docs" / "configuration.md").write_text(markdown(), encoding="utf-8")
    (root / "configs" / "base.yaml").write_text(base_yaml(), encoding="utf-8")


if __name__ == "__main__":
    _write()
