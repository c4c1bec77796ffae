"""Arguments that several verbs share."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from droidw.plugin.manager import Plugins

__all__ = ["add_plugin_arguments", "plugins_from"]


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
