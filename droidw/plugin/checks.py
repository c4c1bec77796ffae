"""What a plugin hands over, checked: pluggy checks neither types nor what a hook returns."""

from __future__ import annotations

import dataclasses
import re
import sys
import typing
import zlib
from collections.abc import Collection, Iterable
from importlib import util
from pathlib import Path
from types import ModuleType
from typing import Any

import pluggy

from droidw.errors import PluginError, nearest
from droidw.plugin.component import Component
from droidw.plugin.registry import KINDS
from droidw.plugin.weights import WeightsFile

__all__ = ["HOOKS", "checked_components", "explained", "import_file", "problem_of"]

HOOKS = {kind.hook: kind.name for kind in KINDS.values()}
"""Hook -> the kind that it offers."""

_NAME = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")


def checked_components(hook: str, answer: object) -> list[Component[Any]]:
    """What a hook returned, as a list.

    Raises:
        PluginError: it is no collection of sound components with different names.
    """
    if isinstance(answer, (Component, str, bytes)) or not isinstance(answer, Iterable):
        raise PluginError(
            f"{hook} returned {_described(answer)}; it must yield Component records "
            "(write `yield droidw.Component(...)`)"
        )
    found: list[Component[Any]] = []
    for item in answer:
        problem = problem_of(item)
        if problem:
            raise PluginError(f"{hook}: {problem}")
        if any(item.name == other.name for other in found):
            raise PluginError(f"{hook} yielded two components called '{item.name}'")
        found.append(item)
    return found


def problem_of(item: object) -> str:
    """What is wrong with a component, or ""."""
    if not isinstance(item, Component):
        return f"yielded {_described(item)} where a droidw.Component is expected"
    record: Any = item  # what its fields are declared as is what is to be checked
    if not isinstance(record.name, str) or not _NAME.fullmatch(record.name):
        return f"the name {record.name!r} is not lower-case kebab, such as 'my-part'"
    if not isinstance(record.summary, str) or len(record.summary.splitlines()) > 1:
        return f"'{record.name}': summary is {record.summary!r}, not one line of text"
    if not callable(record.factory):
        return f"'{record.name}': factory is {_described(record.factory)}, not callable"
    if not isinstance(record.options, type) or not dataclasses.is_dataclass(record.options):
        return f"'{record.name}': options is {_described(record.options)}, not a dataclass"
    for entry in dataclasses.fields(record.options):
        missing = dataclasses.MISSING
        if entry.default is missing and entry.default_factory is missing:
            return f"'{record.name}': option '{entry.name}' has no default"
    problem = _problem_of_options(record.options)
    if problem:
        return f"'{record.name}': options {record.options.__name__}: {problem}"
    for attribute in ("requires", "capabilities"):
        value = getattr(record, attribute)
        several = isinstance(value, Collection) and not isinstance(value, str)
        if not several or not all(isinstance(part, str) for part in value):
            return f"'{record.name}': {attribute} is {value!r}, not a collection of strings"
    return _problem_of_weights(record)


def _problem_of_options(options: type) -> str:
    try:
        typing.get_type_hints(options)
    except Exception as error:  # noqa: BLE001 - strangers' code
        return f"a type cannot be looked up when it runs ({error})"
    try:
        options()
    except Exception as error:  # noqa: BLE001 - strangers' code
        return f"its defaults are refused: {type(error).__name__}: {error}"
    texts = ((entry.name, entry.metadata.get("help", "")) for entry in dataclasses.fields(options))
    for name, text in texts:
        if not isinstance(text, str):
            return f"the help of '{name}' is {text!r}, not text"
    return ""


def _problem_of_weights(record: Any) -> str:
    try:
        wanted = record.weights if isinstance(record.weights, str) else record.weights_for()
    except Exception as error:  # noqa: BLE001 - strangers' code
        return f"'{record.name}': weights raised {type(error).__name__}: {error}"
    if isinstance(wanted, str) or not all(isinstance(w, (str, WeightsFile)) for w in wanted):
        return (
            f"'{record.name}': weights is {wanted!r}, not a collection of names or of "
            "droidw.WeightsFile records"
        )
    return ""


def _described(value: object) -> str:
    return "nothing (None)" if value is None else f"a {type(value).__name__} ({value!r})"


def explained(error: pluggy.PluginValidationError) -> str:
    """pluggy's complaint as one line, with the nearest hook if the name is unknown."""
    text = " ".join(str(error).split())
    match = re.search(r"unknown hook '(\w+)'", text)
    if not match:
        return text
    near = nearest(match[1], HOOKS)
    return f"unknown hook '{match[1]}'" + (
        f"; did you mean '{near}'?" if near else "; hooks: " + ", ".join(HOOKS)
    )


def import_file(path: Path) -> ModuleType:
    """Import a Python file as a module of its own; raises whatever the file raises."""
    digest = zlib.crc32(str(path.resolve()).encode())
    name = f"_droidw_plugin_{digest:08x}_{re.sub(r'[^0-9a-zA-Z_]', '_', path.stem)}"
    spec = util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is not a Python file (its name must end in .py)")
    module = util.module_from_spec(spec)
    # dataclasses look their module up there while the file is executed
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
