"""Finding plugins and loading them one by one, so that a broken one harms nobody else.

pluggy holds the hooks, checks their arguments and refuses unknown ones; what is added here is
isolation, provenance, the load and block lists, and checks of what the hooks return.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import re
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pluggy

from droidw.errors import PluginError, UsageError, did_you_mean
from droidw.plugin import hookspecs
from droidw.plugin.cache import user_cache
from droidw.plugin.checks import HOOKS, checked_components, explained, import_file, problem_of
from droidw.plugin.component import Component
from droidw.plugin.registry import FROM_PYTHON, KINDS, Entry, Failure, Registry

if TYPE_CHECKING:
    from importlib import metadata

__all__ = [
    "DISABLE_VARIABLE",
    "GROUP",
    "HOST",
    "LOAD_VARIABLE",
    "Plugins",
    "load_plugins",
    "register",
]

GROUP = "droidw"
"""Entry-point group in which plugins are found."""

HOST = "droidw"
"""The distribution whose own plugins are loaded whatever `DROIDW_LOAD_PLUGINS` says."""

LOAD_VARIABLE = "DROIDW_LOAD_PLUGINS"
DISABLE_VARIABLE = "DROIDW_DISABLE_PLUGINS"
WEIGHTS_VARIABLE = "DROIDW_WEIGHTS"

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class _Origin:
    plugin: str
    distribution: str
    version: str


class Plugins:
    """All plugins of a process, as far as they could be loaded.

    Args:
        environ: where `DROIDW_DISABLE_PLUGINS` and `DROIDW_WEIGHTS` are looked up.

    Attributes:
        failures: what could not be loaded and why, in the order of loading.
        weights_dir: folder in which weights files are looked for.
        data_dir: folder of datasets for the readers, or None for the usual one.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        self.failures: list[Failure] = []
        self.weights_dir = _weights_dir(environ)
        self.data_dir: Path | None = None
        self._blocked = frozenset(_split(environ.get(DISABLE_VARIABLE, "")))
        self._entries: list[Entry] = []
        self._met: set[str] = set()
        self._manager = pluggy.PluginManager(hookspecs.PROJECT)
        self._manager.add_hookspecs(hookspecs)

    def registry(self, kind: str) -> Registry:
        """The parts of one kind, a key of `droidw.plugin.registry.KINDS`.

        Raises:
            UsageError: there is no such kind.
        """
        if kind not in KINDS:
            raise UsageError(
                f"there is no kind of plugin called '{kind}'",
                did_you_mean(kind, KINDS) + "kinds: " + ", ".join(KINDS),
            )
        entries = [e for e in self._entries if e.kind == kind]
        disabled = self.disabled()
        blocked = {e.component.name for e in entries if _full_name(e) in disabled}
        return Registry(
            KINDS[kind], entries, frozenset(blocked), tuple(self.failures), self.weights_dir
        )

    def disabled(self) -> frozenset[str]:
        """Full names, "kind/name", of the parts that are loaded and switched off."""
        return frozenset(
            _full_name(e)
            for e in self._entries
            if self._blocked & {e.component.name, _full_name(e)}
        )

    def entries(self) -> list[Entry]:
        """Every component of every kind, in the order of loading."""
        return list(self._entries)

    def register(self, plugin: object, name: str | None = None) -> None:
        """Add a module or object whose functions are marked `@droidw.hookimpl`.

        Raises:
            PluginError: it breaks a contract, or its name is taken; nothing of it is kept.
        """
        label = name or getattr(plugin, "__name__", None) or type(plugin).__name__
        failure = self._register(plugin, _Origin(str(label), FROM_PYTHON, ""))
        if failure is not None:
            raise _raised(failure)

    def add(self, kind: str, component: Component[Any]) -> None:
        """Add one component of a kind, without a hook.

        Raises:
            UsageError: there is no such kind.
            PluginError: the component breaks a contract.
        """
        self.registry(kind)
        origin = _Origin(getattr(component, "name", "?"), FROM_PYTHON, "")
        problem = problem_of(component)
        if problem:
            raise PluginError(f"a component of kind '{kind}' {problem}")
        self._entries.append(
            Entry(kind, component, origin.plugin, origin.distribution, origin.version)
        )

    def check(self) -> None:
        """Raise the first thing that is wrong with any plugin (`--strict-plugins`).

        Raises:
            PluginError: a plugin did not load, or two offer the same name.
        """
        if self.failures:
            raise _raised(self.failures[0])
        for kind in KINDS:
            registry = self.registry(kind)
            for name in registry.names():
                if len(registry.providers(name)) > 1:
                    registry.entry(name)

    def load_entry_points(self, only: frozenset[str] | None) -> None:
        """Load what installed distributions offer; `only` limits the third-party ones."""
        from importlib import metadata  # a tenth of a second, which `droidw -h` need not spend

        blocked = {_normal(name) for name in self._blocked}
        found_host = False
        points = sorted(metadata.entry_points(group=GROUP), key=lambda p: (_dist(p), p.name))
        for point in points:
            distribution, version = _dist(point)
            host = _normal(distribution) == HOST
            found_host = found_host or host
            self._met |= {_normal(point.name), _normal(distribution)}
            if only is not None and not host and _normal(distribution) not in only:
                continue
            if blocked & {_normal(point.name), _normal(distribution)}:
                continue
            self._load(_Origin(point.name, distribution, version), point.load)
        for name in sorted((only or frozenset()) - self._met):
            _log.warning("%s: no installed distribution '%s' offers plugins", LOAD_VARIABLE, name)
        if not found_host:
            self._fail(
                _Origin(HOST, HOST, "not installed"),
                "droidw runs from a bare source tree, so its own plugins are not registered; "
                "install it: pip install -e .",
            )

    def warn_of_unknown(self) -> None:
        """Log names in `DROIDW_DISABLE_PLUGINS` that switch nothing off: typing errors, mostly."""
        parts = {name for e in self._entries for name in (e.component.name, _full_name(e))}
        for name in sorted(self._blocked - parts):
            if _normal(name) not in self._met:
                _log.warning("%s: nothing is called '%s'", DISABLE_VARIABLE, name)

    def load_file(self, path: Path) -> Failure | None:
        """Load a plugin from a Python file; returns the failure, which is listed as well.

        Raises:
            UsageError: there is no such file.
        """
        if not path.is_file():
            what = "this is a folder" if path.is_dir() else "there is no such file"
            raise UsageError(
                f"--plugin {path}: {what}",
                "give the path of a Python file; a package is installed instead: pip install -e .",
            )
        return self._load(_Origin(path.stem, str(path), ""), lambda: import_file(path))

    def _load(self, origin: _Origin, load: Callable[[], object]) -> Failure | None:
        try:
            plugin = load()
        except (Exception, SystemExit) as error:  # noqa: BLE001 - strangers' code
            return self._fail(origin, f"{type(error).__name__}: {error}", _trace(error))
        return self._register(plugin, origin)

    def _register(self, plugin: object, origin: _Origin) -> Failure | None:
        """Hand a plugin to pluggy, ask its hooks, check the answers; all of it or nothing."""
        name = f"{origin.distribution}:{origin.plugin}"
        if self._manager.has_plugin(name) or self._manager.is_registered(plugin):
            return self._fail(origin, "it is registered already: was it given twice?")
        try:
            self._manager.register(plugin, name=name)
            self._manager.check_pending()
            entries = self._collect(plugin, origin)
        except pluggy.PluginValidationError as error:
            self._drop(plugin)
            return self._fail(origin, explained(error))
        except PluginError as error:
            self._drop(plugin)
            return self._fail(origin, str(error))
        except Exception as error:  # noqa: BLE001 - strangers' code
            self._drop(plugin)
            return self._fail(origin, f"{type(error).__name__}: {error}", _trace(error))
        self._entries.extend(entries)
        return None

    def _collect(self, plugin: object, origin: _Origin) -> list[Entry]:
        entries: list[Entry] = []
        callers = self._manager.get_hookcallers(plugin) or []
        for caller in callers:
            for impl in caller.get_hookimpls():
                if impl.plugin is not plugin:
                    continue
                if impl.hookwrapper or impl.wrapper:
                    raise PluginError(f"{caller.name}: a hook of droidw cannot be wrapped")
                answer = impl.function()
                entries.extend(
                    Entry(
                        HOOKS[caller.name],
                        component,
                        origin.plugin,
                        origin.distribution,
                        origin.version,
                    )
                    for component in checked_components(caller.name, answer)
                )
        if not callers:
            raise PluginError(
                "it offers nothing: no function in it is marked with @droidw.hookimpl",
                "hooks: " + ", ".join(HOOKS),
            )
        return entries

    def _drop(self, plugin: object) -> None:
        if self._manager.is_registered(plugin):
            self._manager.unregister(plugin)

    def _fail(self, origin: _Origin, error: str, trace: str = "") -> Failure:
        failure = Failure(origin.plugin, origin.distribution, origin.version, error, trace)
        self.failures.append(failure)
        _log.debug("plugin %s of %s did not load: %s", failure.name, failure.origin, error)
        return failure


def load_plugins(
    files: Sequence[str | Path] = (),
    environ: Mapping[str, str] = os.environ,
    extra: Iterable[object] = (),
    *,
    strict: bool = False,
    tolerant: bool = False,
) -> Plugins:
    """Load installed plugins, then files, then objects.

    A broken installed plugin is kept in `Plugins.failures` and harms nobody else. A file or
    object was asked for by name, so its failure is raised, unless `tolerant`.

    Args:
        files: Python files, as `--plugin` gives them.
        environ: `DROIDW_LOAD_PLUGINS` (comma list of third-party distributions to load; empty
            for none) and `DROIDW_DISABLE_PLUGINS` (comma list of plugins, distributions and
            components, the latter also as `kind/name`).
        extra: modules or objects with functions marked `@droidw.hookimpl`.
        strict: raise the first failure or clash at once.
        tolerant: list failures of `files`, too, instead of raising them.
    Raises:
        UsageError: a file does not exist.
        PluginError: a file or object could not be loaded, or `strict` found something.
    """
    plugins = Plugins(environ)
    wanted = environ.get(LOAD_VARIABLE)
    only = None if wanted is None else frozenset(_normal(n) for n in _split(wanted))
    plugins.load_entry_points(only)
    for file in files:
        failure = plugins.load_file(Path(file))
        if failure is not None and not tolerant:
            raise _raised(failure)
    for item in extra:
        plugins.register(item)
    plugins.warn_of_unknown()
    if strict:
        plugins.check()
    return plugins


def register(*things: object, to: Plugins | None = None, **components: Component[Any]) -> Plugins:
    """Bring one's own parts from Python.

    Args:
        things: modules or objects with functions marked `@droidw.hookimpl`.
        to: plugins to add to; all installed ones are loaded if not given.
        components: single components by kind, e.g. `features=Component(...)`.
    Returns:
        The plugins to run with; nothing is kept anywhere else.
    Raises:
        UsageError, PluginError: as `Plugins.register` and `Plugins.add`.

    Example::

        plugins = droidw.register(my_module, features=my_component)
    """
    plugins = load_plugins() if to is None else to
    for thing in things:
        plugins.register(thing)
    for kind, component in components.items():
        plugins.add(kind, component)
    return plugins


def _full_name(entry: Entry) -> str:
    return f"{entry.kind}/{entry.component.name}"


def _raised(failure: Failure) -> PluginError:
    return PluginError(
        f"plugin '{failure.name}' ({failure.origin}) failed to load: {failure.error}",
        failure.hint,
    )


def _trace(error: BaseException) -> str:
    return "".join(traceback.format_exception(type(error), error, error.__traceback__))


def _dist(point: metadata.EntryPoint) -> tuple[str, str]:
    distribution = getattr(point, "dist", None)
    if distribution is None:
        return ("unknown distribution", "")
    return (str(distribution.metadata["Name"]), str(distribution.version))


def _weights_dir(environ: Mapping[str, str]) -> Path:
    if environ.get(WEIGHTS_VARIABLE):
        return Path(environ[WEIGHTS_VARIABLE]).expanduser()
    return user_cache(environ) / "weights"


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _normal(name: str) -> str:
    """A distribution's name as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()
