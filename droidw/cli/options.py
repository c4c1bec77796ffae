"""Arguments that several verbs share."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from droidw.plugin.manager import Plugins

__all__ = ["add_override_argument", "add_plugin_arguments", "plugins_from"]


def add_override_argument(parser: argparse.ArgumentParser) -> None:
    """`key=value ...`, anywhere among the other arguments; they end up in `args.overrides`."""
    # without a default, argparse would call them required when something else is missing
    parser.add_argument(
        "overrides",
        metavar="key=value",
        nargs="*",
        default=[],
        help="set keys of the configuration, for example: camera.long_side=512 depth=none",
    )


def add_plugin_arguments(parser: argparse.ArgumentParser) -> None:
    """`--plugin FILE` (repeatable) and `--strict-plugins`."""
    parser.add_argument(
        "--plugin",
        metavar="FILE",
        action="append",
        default=[],
        help="load a plugin from a Python file; may be given more than once",
    )
    parser.add_argument(
        "--strict-plugins",
        action="store_true",
        help="stop at the first plugin that cannot be loaded",
    )


def plugins_from(args: argparse.Namespace, *, tolerant: bool = False) -> Plugins:
    """The plugins that these arguments ask for.

    Raises:
        UsageError, PluginError: as `droidw.load_plugins`.
    """
    from droidw.plugin.manager import load_plugins

    return load_plugins(args.plugin, strict=args.strict_plugins, tolerant=tolerant)
