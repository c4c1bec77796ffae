"""Typed lookup of what plugins offer: clashes, suggestions, availability."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import util
from pathlib import Path
from typing import Any

from droidw.errors import ConfigError, MissingRequirementError, PluginError, did_you_mean
from droidw.plugin.component import Component
from droidw.plugin.weights import find_weights, weights_name

__all__ = [
    "FETCH",
    "FROM_PYTHON",
    "KINDS",
    "SLOTS",
    "Entry",
    "Failure",
    "Kind",
    "PluginNotFound",
    "Registry",
]


class PluginNotFound(ConfigError):
    """A name was asked for that no plugin of its kind has."""

    exit_code = 5


@dataclass(frozen=True)
class Kind:
    """One kind of part: its hook, and its name in sentences ("a feature extractor")."""

    name: str
    hook: str
    noun: str


KINDS: Mapping[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("features", "droidw_feature_extractors", "feature extractor"),
        Kind("depth", "droidw_depth_priors", "depth prior"),
        Kind("uncertainty", "droidw_uncertainty_models", "uncertainty model"),
        Kind("ba", "droidw_ba_backends", "bundle adjustment backend"),
        Kind("correspondence", "droidw_correspondence_ops", "correspondence operator"),
        Kind("reader", "droidw_dataset_readers", "dataset reader"),
        Kind("exporter", "droidw_exporters", "exporter"),
        Kind("observer", "droidw_observers", "observer"),
    )
}
"""Every kind by name, in the order in which they are listed."""

FETCH = "download them: droidw weights fetch "
"""How the line of a hint begins that says how to get weights that are missing."""

FROM_PYTHON = "registered from Python"
"""Stands for the distribution of what a program brought along itself."""

SLOTS: tuple[str, ...] = ("features", "depth", "uncertainty", "ba", "correspondence", "reader")
"""Kinds of which a run has exactly one; the key in the configuration is the name of the kind."""


@dataclass(frozen=True)
class Entry:
    """A component and where it comes from.

    Attributes:
        kind: key of `KINDS`.
        component: the record that the plugin yielded.
        plugin: name of the plugin (entry point, file name, or module).
        distribution, version: of the installed package; for a file its path and "".
    """

    kind: str
    component: Component[Any]
    plugin: str
    distribution: str
    version: str

    @property
    def origin(self) -> str:
        """Distribution and version, e.g. "droidw 0.1.0"."""
        return f"{self.distribution} {self.version}".strip()


@dataclass(frozen=True)
class Failure:
    """A plugin that could not be loaded.

    Attributes:
        name: of the plugin (entry point, file name, or module).
        distribution, version: as in `Entry`.
        error: one line, e.g. "ModuleNotFoundError: No module named 'acme_net'".
        traceback: the full text, or "" where there is nothing more to say.
    """

    name: str
    distribution: str
    version: str
    error: str
    traceback: str = ""

    @property
    def origin(self) -> str:
        """Distribution and version, e.g. "droidw-acme 1.2"."""
        return f"{self.distribution} {self.version}".strip()

    @property
    def hint(self) -> str:
        """What to type to see the traceback; "" where there is none, or no command can show it."""
        if not self.traceback or self.distribution == FROM_PYTHON:
            return ""
        from_file = not self.version and Path(self.distribution).is_file()
        file = f"--plugin {shlex.quote(self.distribution)} " if from_file else ""
        return f"see: droidw list-plugins {file}--traceback {shlex.quote(self.name)}"


@dataclass(frozen=True)
class Registry:
    """The parts of one kind by name.

    Attributes:
        kind: what they are.
        entries: all that were offered, in the order of loading, clashes included.
        blocked: names switched off by `DROIDW_DISABLE_PLUGINS`.
        failures: plugins that did not load; named when an unknown part is asked for.
        weights_dir: where weights files are looked for.
    """

    kind: Kind
    entries: Sequence[Entry] = ()
    blocked: frozenset[str] = frozenset()
    failures: Sequence[Failure] = ()
    weights_dir: Path | None = None
    _by_name: dict[str, list[Entry]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        by_name: dict[str, list[Entry]] = {}
        for entry in self.entries:
            by_name.setdefault(entry.component.name, []).append(entry)
        object.__setattr__(self, "_by_name", by_name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def __len__(self) -> int:
        return len(self._by_name)

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def names(self) -> list[str]:
        """All names in alphabetical order, blocked and unusable ones included."""
        return sorted(self._by_name)

    def providers(self, name: str) -> list[Entry]:
        """Everyone who offers `name`; more than one is a clash, none is an unknown name."""
        return list(self._by_name.get(name, []))

    def entry(self, name: str) -> Entry:
        """The component of that name with its origin.

        Raises:
            PluginNotFound: nobody offers it; says the nearest name and all names.
            PluginError: two plugins offer it, or the plugin of that name failed to load.
            MissingRequirementError: it is switched off.
        """
        found = self._by_name.get(name, [])
        if not found:
            raise self._not_found(name)
        if name in self.blocked:
            raise MissingRequirementError(
                f"the {self.kind.noun} '{name}' is switched off by DROIDW_DISABLE_PLUGINS",
                f"take its name out of that variable, or choose another: {self._available()}",
            )
        if len(found) > 1:
            origins = [f"{e.origin} (plugin '{e.plugin}')" for e in found]
            # What comes with droidw is more than this name, and a file is not switched off by one.
            others = [e for e in found if e.distribution != "droidw" and e.version]
            advice = "give it another name, or leave out its file (--plugin)"
            if others:
                advice = f"switch one off: DROIDW_DISABLE_PLUGINS={others[-1].plugin}"
            raise PluginError(
                f"the {self.kind.noun} '{name}' is offered by "
                + " and by ".join(origins)
                + "; a name must be unique within its kind",
                advice,
            )
        return found[0]

    def get(self, name: str) -> Component[Any]:
        """The component of that name; raises as `entry` does."""
        return self.entry(name).component

    def status(self, name: str, options: Any = None) -> str:
        """Say "ready", or in a few words why the part cannot be used with these options.

        Examples: "needs droidw[open3d]", "weights missing: droid", "no GPU visible".

        Raises:
            PluginNotFound: nobody offers it.
        """
        found = self._by_name.get(name, [])
        if not found:
            raise self._not_found(name)
        if name in self.blocked:
            return "switched off"
        if len(found) > 1:
            return "name clash: " + ", ".join(e.origin for e in found)
        entry = found[0]
        component = entry.component
        packages = _missing_packages(component)
        if packages:
            if component.extra and entry.version:
                return f"needs {entry.distribution}[{component.extra}]"
            return "needs " + ", ".join(packages)
        weights = self._missing_weights(component, options)
        if weights:
            return "weights missing: " + ", ".join(weights)
        return _unavailable(component) or "ready"

    def require(self, name: str, options: Any = None) -> Component[Any]:
        """The component of that name, which can be used here with these options.

        Raises:
            MissingRequirementError: a package, an extra, weights or a device is missing; says
                what to install. Otherwise as `entry`.
        """
        entry = self.entry(name)
        component = entry.component
        packages = _missing_packages(component)
        if packages:
            listed = ", ".join(f"'{p}'" for p in packages)
            verb = "package {} is" if len(packages) == 1 else "packages {} are"
            what = (
                f"'{entry.distribution}[{component.extra}]'"
                if component.extra and entry.version
                else " ".join(packages)
            )
            raise MissingRequirementError(
                f"'{name}' is registered but cannot run: Python {verb.format(listed)} missing",
                f"install it: pip install {what}" + self._instead(name),
            )
        weights = self._missing_weights(component, options)
        if weights:
            raise MissingRequirementError(
                f"'{name}' is registered but cannot run: its weights "
                + ", ".join(f"'{w}'" for w in weights)
                + f" are not in {self.weights_dir or 'any folder: none is set'}",
                "".join(f"{FETCH}{w}\n" for w in weights)
                + "or add a file that is on disk: droidw weights add FILE\n"
                "or name the folder that has them: DROIDW_WEIGHTS=FOLDER" + self._instead(name),
            )
        reason = _unavailable(component)
        if reason:
            raise MissingRequirementError(
                f"'{name}' is registered but cannot run here: {reason}",
                "choose another" + self._instead(name),
            )
        return component

    def _missing_weights(self, component: Component[Any], options: Any) -> list[str]:
        wanted = component.weights_for(options)
        return [weights_name(w) for w in wanted if find_weights(self.weights_dir, w) is None]

    def _available(self) -> str:
        return ", ".join(n for n in self.names() if n not in self.blocked) or "none are registered"

    def _instead(self, name: str) -> str:
        if name != "none" and "none" in self._by_name and "none" not in self.blocked:
            return f"\nor run without: {self.kind.name}=none"
        return f"\nsee: droidw list-plugins --kind {self.kind.name}"

    def _not_found(self, name: str) -> PluginError | PluginNotFound:
        for failure in self.failures:
            if failure.name == name:
                return PluginError(
                    f"plugin '{name}' of {failure.origin} failed to load: {failure.error}",
                    failure.hint,
                )
        hint = did_you_mean(name, self.names()) + f"available: {self._available()}"
        for failure in self.failures:
            hint += f"\nnot loaded: {failure.name} ({failure.origin}): {failure.error}"
        hint += f"\nsee: droidw list-plugins --kind {self.kind.name}"
        return PluginNotFound(f"no {self.kind.noun} is called '{name}'", hint)


def _missing_packages(component: Component[Any]) -> list[str]:
    return [name for name in component.requires if not _importable(name)]


def _importable(name: str) -> bool:
    """Whether the top-level package can be found; asking for more would import it."""
    try:
        return util.find_spec(name.partition(".")[0]) is not None
    except ValueError:  # a module in sys.modules without a spec is importable all the same
        return True


def _unavailable(component: Component[Any]) -> str:
    if component.available is None:
        return ""
    try:
        why: object = component.available()
    except (Exception, SystemExit) as error:  # noqa: BLE001 - strangers' code
        return f"its check raised {type(error).__name__}: {error}"
    return why if isinstance(why, str) else f"its check returned {why!r}, not why it cannot run"
