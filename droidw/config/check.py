"""Values against dataclasses: unknown keys, types and ranges, refused with the full key."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Union

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from droidw.config.describe import limits_text, type_text, within
from droidw.config.load import LoadedConfig
from droidw.errors import ConfigError, PluginError, did_you_mean

__all__ = ["check_keys", "check_ranges", "typed"]


def check_keys(cls: type, data: Mapping[str, Any], prefix: str, loaded: LoadedConfig) -> None:
    """Refuse keys that a dataclass (or one nested in it) does not have.

    Args:
        cls: the dataclass.
        data: values for it, a plain tree.
        prefix: full key of `data`, or "".
        loaded: knows where each key was written.
    Raises:
        ConfigError: with the nearest key and all valid ones.
    """
    hints = typing.get_type_hints(cls)
    names = [entry.name for entry in dataclasses.fields(cls)]
    for key, value in data.items():
        full = f"{prefix}.{key}" if prefix else str(key)
        if key not in names:
            where = prefix or "the top level"
            deeper = "options" in names and "name" in names
            raise ConfigError(
                f"{loaded.at(full)}: there is no such key",
                did_you_mean(str(key), names, before=f"{prefix}." if prefix else "")
                + f"keys of {where}: {', '.join(names) or 'none'}"
                + (f"\noptions of the plugin go below {prefix}.options" if deeper else ""),
            )
        inner = _dataclass_in(hints[key])
        if inner is None:
            continue
        if typing.get_origin(hints[key]) is not dict:
            check_keys(inner, _section(inner, value, full, loaded), full, loaded)
        elif isinstance(value, Mapping):
            for name, item in value.items():
                below = f"{full}.{name}"
                check_keys(inner, _section(inner, item, below, loaded), below, loaded)


def typed(cls: type, data: Mapping[str, Any], prefix: str, loaded: LoadedConfig) -> Any:
    """An instance of a dataclass with these values, converted and type-checked.

    Raises:
        ConfigError: a value has the wrong type, or the dataclass itself refuses it; with what
            would be valid.
        PluginError: the dataclass has a field of a type that YAML cannot hold.
    """
    try:
        defaults = OmegaConf.structured(cls)
    except OmegaConfBaseException as error:
        raise PluginError(
            f"{prefix}: the options {cls.__name__} hold a type that a configuration cannot: "
            + _first_line(error),
            "valid: bool, int, float, str, Path, Enum, Literal; lists, tuples and dicts of them",
        ) from error
    try:
        OmegaConf.set_readonly(defaults, False)  # as it is of a frozen dataclass
        for name, hint in typing.get_type_hints(cls).items():
            if typing.get_origin(hint) is dict and isinstance(data.get(name), Mapping):
                defaults[name] = {}  # else keys that were taken out would come back
        node = OmegaConf.unsafe_merge(defaults, dict(data))  # both are used once
        made = OmegaConf.to_object(node)
    except OmegaConfBaseException as error:
        key = str(getattr(error, "full_key", "") or "")
        full = ".".join(part for part in (prefix, key.replace("[", ".").replace("]", "")) if part)
        value, hint = _value_at(data, key), _hint_at(cls, key)
        expected = f"expected: {type_text(hint)}" if hint is not None else _first_line(error)
        raise ConfigError(f"{loaded.at(full)}: {value!r} is not valid here", expected) from error
    except (TypeError, ValueError) as error:  # raised by __post_init__ of the dataclass
        raise ConfigError(f"{loaded.at(prefix or 'config')}: {error}") from error
    return _with_tuples(made)


def check_ranges(instance: Any, prefix: str, loaded: LoadedConfig) -> None:
    """Refuse numbers outside the limits in `field(metadata=...)`, and any that are not finite.

    Raises:
        ConfigError: with the valid range.
    """
    for entry in dataclasses.fields(instance):
        value = getattr(instance, entry.name)
        full = f"{prefix}.{entry.name}" if prefix else entry.name
        if dataclasses.is_dataclass(value):
            check_ranges(value, full, loaded)
        elif isinstance(value, dict):
            for name, item in value.items():
                if dataclasses.is_dataclass(item):
                    check_ranges(item, f"{full}.{name}", loaded)
        else:
            items = value if isinstance(value, (list, tuple)) else [value]
            for item in items:
                if isinstance(item, (int, float)) and not isinstance(item, bool):
                    _check_number(item, entry.metadata, full, loaded)


def _check_number(
    value: float, metadata: Mapping[str, Any], full: str, loaded: LoadedConfig
) -> None:
    limits = limits_text(metadata)
    if not math.isfinite(value):
        raise ConfigError(
            f"{loaded.at(full)}: {value} is not a finite number", limits and f"valid: {limits}"
        )
    if not within(value, metadata):
        raise ConfigError(f"{loaded.at(full)}: {value} is out of range", f"valid: {limits}")


def _section(cls: type, value: Any, full: str, loaded: LoadedConfig) -> Mapping[str, Any]:
    if isinstance(value, Mapping):
        return value
    names = ", ".join(entry.name for entry in dataclasses.fields(cls))
    raise ConfigError(
        f"{loaded.at(full)}: {value!r} is not valid here", f"expected a section with keys: {names}"
    )


def _dataclass_in(hint: Any) -> type | None:
    """The dataclass of a hint such as `PhaseConfig` or `dict[str, PhaseConfig]`."""
    for candidate in (hint, *typing.get_args(hint)):
        if isinstance(candidate, type) and dataclasses.is_dataclass(candidate):
            return candidate
    return None


def _value_at(data: Any, key: str) -> Any:
    for part in key.replace("[", ".").replace("]", "").split("."):
        if isinstance(data, Mapping):
            data = data.get(part)
        elif isinstance(data, (list, tuple)) and part.isdigit() and int(part) < len(data):
            data = data[int(part)]
    return data


def _hint_at(cls: type, key: str) -> Any:
    """The type of a key, or None if it cannot be told."""
    hint: Any = cls
    for part in key.replace("[", ".").replace("]", "").split("."):
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            hint = typing.get_type_hints(hint).get(part)
            continue
        if typing.get_origin(hint) in (Union, types.UnionType):
            hint = next(a for a in typing.get_args(hint) if a is not type(None))
        args = typing.get_args(hint)
        if not args:
            return None
        hint = args[-1] if typing.get_origin(hint) is dict else args[0]
    return hint


def _with_tuples(instance: Any) -> Any:
    """Lists back to tuples where the dataclass says tuple: OmegaConf knows only lists."""
    changed = {
        name: tuple(getattr(instance, name))
        for name, hint in typing.get_type_hints(type(instance)).items()
        if typing.get_origin(hint) is tuple and isinstance(getattr(instance, name, None), list)
    }
    return dataclasses.replace(instance, **changed) if changed else instance


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
