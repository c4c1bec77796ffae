"""`droidw list-plugins`: every part, whether it can run here, and what failed to load."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from droidw.cli.options import add_plugin_arguments, plugins_from
from droidw.errors import UsageError, did_you_mean
from droidw.plugin.registry import KINDS, Entry, PluginNotFound
from droidw.plugin.weights import weights_name

if TYPE_CHECKING:
    from droidw.plugin.manager import Plugins

__all__ = ["HELP", "add_arguments", "main"]

# Name of a preset -> configuration.
_Presets = Mapping[str, Mapping[str, Any]]

HELP = "list the parts that plugins offer, whether they can run here, and their options"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `droidw list-plugins`."""
    parser.add_argument("--kind", choices=tuple(KINDS), help="only parts of this kind")
    parser.add_argument(
        "--from", dest="distribution", metavar="DIST", help="only parts of this distribution"
    )
    parser.add_argument(
        "--options",
        metavar="NAME",
        help="the options of one part: type, default, what presets set, meaning",
    )
    parser.add_argument(
        "--traceback", metavar="NAME", help="why the plugin of this name failed to load, in full"
    )
    parser.add_argument("--json", action="store_true", help="the same facts as JSON")
    add_plugin_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Print the list.

    Raises:
        PluginNotFound, UsageError: a NAME or DIST is not known; says which are.
    """
    from droidw.cli.render import as_json

    plugins = plugins_from(args, tolerant=True)
    if args.traceback:
        print(_traceback(plugins, args.traceback))
        return 0
    if args.options:
        entries, presets = _named(plugins, args.options, args.kind), _presets()
        if args.json:
            print(as_json([_facts(plugins, entry, presets) for entry in entries]))
        else:
            print("\n\n".join(_options(plugins, entry, presets) for entry in entries))
        return 0
    entries = _selected(plugins, args.kind, args.distribution)
    if args.json:
        failures = [dataclasses.asdict(failure) for failure in plugins.failures]
        presets = _presets()
        facts = [_facts(plugins, entry, presets) for entry in entries]
        print(as_json({"plugins": facts, "failures": failures}))
    else:
        print(_listing(plugins, entries))
    return 0


def _selected(plugins: Plugins, kind: str | None, distribution: str | None) -> list[Entry]:
    """Entries in the order of kinds, then by name."""
    order = list(KINDS)
    entries = [e for e in plugins.entries() if kind in (None, e.kind)]
    if distribution is not None:
        known = sorted({e.distribution for e in plugins.entries()})
        if distribution not in known:
            raise UsageError(
                f"--from: no part comes from '{distribution}'",
                did_you_mean(distribution, known) + f"packages: {', '.join(known)}",
            )
        entries = [e for e in entries if e.distribution == distribution]
    return sorted(entries, key=lambda e: (order.index(e.kind), e.component.name))


def _listing(plugins: Plugins, entries: list[Entry]) -> str:
    from droidw.cli.render import table, terminal_width

    rows = [
        (
            e.component.name,
            plugins.registry(e.kind).status(e.component.name),
            "*" if _is_default(e) else "",
            e.component.summary,
            e.origin,
        )
        for e in entries
    ]
    lines = table(rows, indent=2, width=terminal_width(118)).splitlines()
    text: list[str] = []
    for k, (entry, line) in enumerate(zip(entries, lines, strict=True)):
        if k == 0 or entries[k - 1].kind != entry.kind:
            text.append(entry.kind)
        text.append(line)
    if plugins.failures:
        text.append("failed to load")
        text.append(
            table(
                [
                    (
                        f.name,
                        f.origin,
                        " ".join(f.error.split())
                        + (f"  (--traceback {f.name})" if f.traceback else ""),
                    )
                    for f in plugins.failures
                ],
                indent=2,
            )
        )
    packages = len({e.distribution for e in entries})
    count = f"{len(entries)} part{'s' * (len(entries) != 1)}"
    origin = f"{packages} package{'s' * (packages != 1)}"
    text += [
        "",
        f"* default.  {count} from {origin}.  Options of one: droidw list-plugins --options NAME",
    ]
    return "\n".join(text)


def _is_default(entry: Entry) -> bool:
    from droidw.config.schema import DroidwConfig

    config = DroidwConfig()
    if entry.kind in ("exporter", "observer"):
        return entry.component.name in getattr(config, entry.kind + "s")
    return bool(getattr(config, entry.kind).name == entry.component.name)


def _named(plugins: Plugins, name: str, kind: str | None) -> list[Entry]:
    entries = [e for e in _selected(plugins, kind, None) if e.component.name == name]
    if entries:
        return entries
    if kind is not None:
        plugins.registry(kind).entry(name)  # raises, with the nearest of that kind
    names = sorted({e.component.name for e in plugins.entries()})
    raise PluginNotFound(
        f"--options: no part is called '{name}'",
        did_you_mean(name, names) + f"parts: {', '.join(names) or 'none'}",
    )


def _option_rows(entry: Entry, presets: _Presets) -> list[dict[str, Any]]:
    """Options as described; `presets` holds the values of those that presets set."""
    from droidw.config.describe import rows

    found: list[dict[str, Any]] = [dataclasses.asdict(row) for row in rows(entry.component.options)]
    for preset, slots in presets.items():
        slot = slots.get(entry.kind, {})
        chosen = slot["options"] if slot.get("name") == entry.component.name else {}
        for option in found:
            if option["key"] in chosen:
                option.setdefault("presets", {})[preset] = chosen[option["key"]]
    return found


def _presets() -> _Presets:
    """Which parts the presets that come with droidw choose, and with what options."""
    from droidw.config.load import load_config
    from droidw.config.packaged import packaged_in

    return {name: load_config(preset=name).data for name in packaged_in("presets")}


def _key(entry: Entry) -> str:
    """Where the options of this part stand in a configuration."""
    if entry.kind in ("exporter", "observer"):
        return f"{entry.kind}s.{entry.component.name}"
    return f"{entry.kind}.options"


def _options(plugins: Plugins, entry: Entry, presets: _Presets) -> str:
    from droidw.cli.render import paragraph, table

    component = entry.component
    status = plugins.registry(entry.kind).status(component.name)
    text = [
        f"{KINDS[entry.kind].noun} {component.name}   {status}   {entry.origin}",
        paragraph(f"  {component.summary}", indent=2),
    ]
    if component.reference:
        text.append(paragraph(f"  {component.reference}", indent=2))
    options = _option_rows(entry, presets)
    if not options:
        return "\n".join([*text, "  it has no options"])
    said = [_said(option.get("presets", {})) for option in options]
    shown = any(said)  # a column for what presets set, if they set anything
    rows = [("option", "type", "default", *["in presets"] * shown, "range", "meaning")]
    rows += [
        (f"{_key(entry)}.{o['key']}", o["type"], o["default"], *[v] * shown, o["limits"], o["help"])
        for o, v in zip(options, said, strict=True)
    ]
    return "\n".join([*text, "", table(rows, indent=2)])


def _said(values: Mapping[str, Any]) -> str:
    """Value by preset on one line, those together that set the same."""
    names: dict[str, list[str]] = {}
    for preset, value in values.items():
        names.setdefault(str(value), []).append(preset)
    return "; ".join(f"{', '.join(presets)}: {value}" for value, presets in names.items())


def _facts(plugins: Plugins, entry: Entry, presets: _Presets) -> dict[str, Any]:
    component = entry.component
    return {
        "kind": entry.kind,
        "name": component.name,
        "status": plugins.registry(entry.kind).status(component.name),
        "default": _is_default(entry),
        "summary": component.summary,
        "plugin": entry.plugin,
        "distribution": entry.distribution,
        "version": entry.version,
        "requires": list(component.requires),
        "extra": component.extra,
        "weights": [weights_name(w) for w in component.weights_for()],
        "capabilities": sorted(component.capabilities),
        "reference": component.reference,
        "options_key": _key(entry),
        "options": _option_rows(entry, presets),
    }


def _traceback(plugins: Plugins, name: str) -> str:
    found = [f for f in plugins.failures if name in (f.name, f.distribution)]
    if not found:
        names = [f.name for f in plugins.failures]
        raise UsageError(
            f"--traceback: no plugin called '{name}' failed to load",
            f"failed: {', '.join(names)}" if names else "every plugin was loaded",
        )
    return "\n".join(f"{f.name} ({f.origin}): {f.error}\n{f.traceback}".rstrip() for f in found)
