"""Names become components, options become dataclasses; whatever does not fit is refused here.

Nothing heavy is loaded: a configuration is accepted or refused before any model exists.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from droidw.config.check import check_keys, check_ranges, typed
from droidw.config.inert import check_inert
from droidw.config.load import COMMAND_LINE, LISTED, LoadedConfig, load_config
from droidw.config.packaged import packaged_in
from droidw.config.plain import plain
from droidw.config.reading import Source
from droidw.config.schema import DroidwConfig
from droidw.errors import (
    ConfigError,
    DroidwError,
    MissingRequirementError,
    PluginError,
    did_you_mean,
)
from droidw.geometry.sizes import SMALLEST
from droidw.plugin.component import Component
from droidw.plugin.manager import Plugins
from droidw.plugin.registry import FETCH, SLOTS, Entry, PluginNotFound

__all__ = ["COMPAT", "ResolvedConfig", "choose_preset", "needs_preset", "resolve"]

COMPAT = ("droid-w",)
"""Published behaviours that `compat` may ask for."""

_ON_DEVICE = ("features", "depth", "uncertainty", "ba", "correspondence")

_MISSING = (PluginNotFound, MissingRequirementError, PluginError)
"""What may be wrong with several parts at a time, and is then told of all."""

Part = tuple[Component[Any], Any]


@dataclass(frozen=True)
class ResolvedConfig:
    """A configuration that fits: typed values, and the component behind each name.

    Attributes:
        config: the whole configuration; slots hold their options in full.
        parts: slot -> (component, options); without "reader" where it is `auto`.
        exporters, observers: (component, options) of those switched on, in the order written.
        devices: devices that every part can run on, of "cpu" and "cuda".
        sources: full key -> where it was set; keys at their default are absent.
        preset: name of the preset, or None.
        origins: slot, `exporters.NAME` or `observers.NAME` -> where the part comes from.
    """

    config: DroidwConfig
    parts: Mapping[str, Part]
    exporters: Sequence[Part] = ()
    observers: Sequence[Part] = ()
    devices: frozenset[str] = frozenset({"cpu", "cuda"})
    sources: Mapping[str, Source] = field(default_factory=dict)
    preset: str | None = None
    origins: Mapping[str, Entry] = field(default_factory=dict)

    @property
    def suits_gpu(self) -> bool:
        """Whether `device: auto` takes a GPU that is there: all parts run on one, none by the host.

        A part with the capability "host" takes tensors of a GPU and computes on the processor all
        the same; a run around it is kept on the processor unless another part runs on a GPU only.
        """
        if "cuda" not in self.devices:
            return False
        by_host = any("host" in part.capabilities for part, _ in self.parts.values())
        return not (by_host and "cpu" in self.devices)

    def to_yaml(self) -> str:
        """A file that can be run again and resolves to the same configuration."""
        lines = ["# Resolved configuration of a run; it can be run again and means the same."]
        if self.preset:
            lines.append(f"# preset: {self.preset}")
        lines += [
            f"# {key}: {entry.component.name}, from {entry.origin}"
            for key, entry in self.origins.items()
        ]
        tree = plain(self.config)
        for section in LISTED:  # what is off has to be said, or the defaults would come back
            usual = dict.fromkeys(getattr(DroidwConfig(), section))
            tree[section] = {**usual, **tree[section]}
        body = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)
        return "\n".join(lines) + "\n" + str(body)


def resolve(loaded: LoadedConfig, plugins: Plugins) -> ResolvedConfig:
    """Check a configuration and find its parts.

    Raises:
        ConfigError: a key, value or combination is refused.
        PluginNotFound: a name has no plugin.
        MissingRequirementError: a chosen part lacks a package, weights or a device.
        PluginError: a chosen part comes from a broken plugin, or two plugins claim its name.
    """
    check_keys(DroidwConfig, loaded.data, "", loaded)
    config = typed(DroidwConfig, loaded.data, "", loaded)
    check_ranges(config, "", loaded)
    _check_values(config, loaded)

    parts: dict[str, Part] = {}
    origins: dict[str, Entry] = {}
    problems: list[DroidwError] = []
    for slot in SLOTS:
        chosen = getattr(config, slot)
        if slot == "reader" and chosen.name == "auto":
            if chosen.options:
                key = f"reader.options.{next(iter(chosen.options))}"
                raise ConfigError(
                    f"{loaded.at(key)}: `auto` has no options",
                    "name the reader that they are for: reader=NAME",
                )
            continue
        try:
            part, options, origins[slot] = _part(
                plugins,
                slot,
                chosen.name,
                f"{slot}.name",
                chosen.options,
                f"{slot}.options",
                loaded,
            )
        except _MISSING as error:
            problems.append(error)
            continue
        chosen.options = plain(options)
        parts[slot] = (part, options)
    listed: dict[str, list[Part]] = {}
    for section in LISTED:
        listed[section] = []
        for name, given in getattr(config, section).items():
            if given is None:
                continue
            key = f"{section}.{name}"
            if not isinstance(given, dict):
                raise ConfigError(
                    f"{loaded.at(key)}: {given!r} is neither a mapping of options nor null",
                    f"{key}={{}} switches it on, {key}=null off",
                )
            try:
                part, options, origins[key] = _part(
                    plugins, section[:-1], name, key, given, key, loaded
                )
            except _MISSING as error:
                problems.append(error)
                continue
            getattr(config, section)[name] = plain(options)
            listed[section].append((part, options))
    if problems:
        raise _joined(problems, loaded)
    devices = _check_fit(config, parts, loaded, plugins)
    return ResolvedConfig(
        config,
        parts,
        tuple(listed["exporters"]),
        tuple(listed["observers"]),
        devices,
        loaded.sources,
        loaded.preset,
        origins,
    )


def needs_preset(files: Sequence[str | Path]) -> bool:
    """Whether configuration files are only changes, which mean little without a preset below them.

    Those that are or extend a preset, or set every section, as the `config.yaml` of a run does,
    say all by themselves. No files need one, too.

    Raises:
        ConfigError: as `load_config`.
    """
    loaded = load_config(files)
    presets = {path.resolve() for path in packaged_in("presets").values()}
    sections = {key.partition(".")[0] for key in loaded.sources}
    read = {Path(file).resolve() for file in loaded.files}
    return presets.isdisjoint(read) and not sections >= set(loaded.data)


def choose_preset(plugins: Plugins) -> tuple[str, str]:
    """What `--preset auto` means here: `paper` if all of its parts can run, else `cpu`.

    Returns:
        The name of the preset, and a sentence that says why.
    """
    loaded = load_config(preset="paper")
    data = loaded.data
    missing = []
    for slot in SLOTS:
        name = data[slot]["name"]
        if slot == "reader" and name == "auto":
            continue
        registry = plugins.registry(slot)
        status = "not installed"
        if name in registry:
            component = registry.providers(name)[0].component
            options = _options(component, data[slot]["options"], f"{slot}.options", loaded)
            status = registry.status(name, options)
        if status != "ready":
            missing.append(f"{slot} '{name}' ({status})")
    if missing:
        return "cpu", "preset cpu, since paper lacks " + ", ".join(missing)
    return "paper", "preset paper, since all of its parts are ready"


def _part(
    plugins: Plugins,
    kind: str,
    name: str,
    key: str,
    given: Mapping[str, Any],
    options_key: str,
    loaded: LoadedConfig,
) -> tuple[Component[Any], Any, Entry]:
    """The component of that name, ready to use, and its options.

    Which weights it needs may depend on the options. Errors say the key and where it was written.
    """
    registry = plugins.registry(kind)
    try:
        entry = registry.entry(name)
        options = _options(entry.component, given, options_key, loaded)
        return registry.require(name, options), options, entry
    except _MISSING as error:
        raise type(error)(f"{loaded.at(key)}: {error.message}", error.hint) from error


def _options(
    component: Component[Any], given: Mapping[str, Any], key: str, loaded: LoadedConfig
) -> Any:
    check_keys(component.options, given, key, loaded)
    options = typed(component.options, given, key, loaded)
    check_ranges(options, key, loaded)
    return options


def _joined(problems: Sequence[DroidwError], loaded: LoadedConfig) -> DroidwError:
    """One error for all parts that are missing: nobody wants to learn of them one by one."""
    first, *others = problems
    hint = first.hint + "".join(f"\nalso: {other.message}" for other in others)
    lines = [line for problem in problems for line in problem.hint.splitlines()]
    names = [line.removeprefix(FETCH) for line in lines if line.startswith(FETCH)]
    if len(names) > 1:
        hint += f"\nall of them: droidw weights fetch {' '.join(dict.fromkeys(names))}"
    if loaded.preset and f"{loaded.preset}.yaml:" in first.message.partition(": ")[0] + ":":
        hint += (
            f"\npreset '{loaded.preset}' names these parts; --preset auto takes what can run here"
        )
    return type(first)(first.message, hint)


def _check_values(config: DroidwConfig, loaded: LoadedConfig) -> None:
    """What types and ranges of single keys cannot say."""
    size = config.camera.size
    if size and (len(size) != 2 or min(size) < SMALLEST):
        raise ConfigError(
            f"{loaded.at('camera.size')}: {size} is not a working size",
            f"valid: [width, height], each at least {SMALLEST}, or [] to follow camera.long_side",
        )
    least, most = config.weighting.min_disp, config.weighting.max_disp
    if 0 < most <= least:
        raise ConfigError(
            f"{loaded.at('weighting.max_disp')}: {most:g} is not more than weighting.min_disp, "
            f"{least:g}, and nothing lies between",
            "valid: a larger one, or 0 for none",
        )
    said = [key for key in ("calib", "focal", "fov") if getattr(config.camera, key) is not None]
    if len(said) > 1:
        of_files = (k for k in said if not loaded.at(f"camera.{k}").startswith(COMMAND_LINE))
        old = next(of_files, said[0])
        raise ConfigError(
            f"{loaded.at('camera.' + said[-1])}: {' and '.join(said)} are given, but only one of "
            "them can hold",
            "give one of --calib FILE, --focal PIXELS, --fov DEGREES; one that a file sets is off "
            f"with camera.{old}=null",
        )
    phases = list(DroidwConfig().schedule)
    for phase in config.schedule:
        if phase not in phases:
            raise ConfigError(
                f"{loaded.at(f'schedule.{phase}')}: there is no such phase",
                did_you_mean(phase, phases, before="schedule.") + f"phases: {', '.join(phases)}",
            )
    check_inert(config, loaded)
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", config.device):
        raise ConfigError(
            f"{loaded.at('device')}: '{config.device}' is not a device",
            "valid: auto, cpu, cuda, cuda:0, cuda:1, ...",
        )
    for name in config.compat:
        if name not in COMPAT:
            raise ConfigError(
                f"{loaded.at('compat')}: no published behaviour is called '{name}'",
                did_you_mean(name, COMPAT) + f"valid: {', '.join(COMPAT)}",
            )


def _check_fit(
    config: DroidwConfig, parts: Mapping[str, Part], loaded: LoadedConfig, plugins: Plugins
) -> frozenset[str]:
    """Whether the parts fit each other and the device; returns the devices they share."""
    model, extractor = parts["uncertainty"][0], parts["features"][0]
    if "features" in model.capabilities and "features" not in extractor.capabilities:
        raise ConfigError(
            f"{loaded.at('uncertainty.name')}: '{model.name}' needs features, and the feature "
            f"extractor '{extractor.name}' gives none",
            "choose another extractor (features=NAME), or run without uncertainty: "
            "uncertainty=none; a plugin says that it gives some by "
            "capabilities={'cpu', 'features'} in its Component",
        )
    devices = frozenset({"cpu", "cuda"})
    wanted = config.device.partition(":")[0]
    for slot in _ON_DEVICE:
        part = parts[slot][0]
        able = part.capabilities & {"cpu", "cuda"}
        if wanted != "auto" and wanted not in able:
            raise ConfigError(
                f"{loaded.at('device')}: {slot} '{part.name}' does not run on {wanted}",
                f"it runs on: {', '.join(sorted(able)) or 'no device that it names'}; "
                f"choose another device, or {_running_on(plugins, slot, wanted)}",
            )
        if not devices & able:
            others = ", ".join(f"{s} '{parts[s][0].name}'" for s in _ON_DEVICE if s != slot)
            raise ConfigError(
                f"{loaded.at(slot + '.name')}: '{part.name}' runs only on "
                f"{', '.join(sorted(able)) or 'no device'}, where not all other parts do",
                f"the others: {others}",
            )
        devices &= able
    return devices


def _running_on(plugins: Plugins, slot: str, device: str) -> str:
    """What to write for a part of a kind that runs on a device."""
    fit = {
        entry.component.name
        for entry in plugins.entries()
        if entry.kind == slot and device in entry.component.capabilities
    }
    return " or ".join(f"{slot}={name}" for name in sorted(fit)) or f"another part ({slot}=NAME)"
