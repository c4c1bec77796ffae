"""The built-in exporters, offered through the entry-point group `droidw`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from droidw.plugin.component import Component
from droidw.plugin.hookspecs import hookimpl

if TYPE_CHECKING:
    from droidw.interfaces.exporters import Exporter

__all__ = ["droidw_exporters"]


@hookimpl
def droidw_exporters() -> Iterable[Component[Exporter]]:
    """Light records only: the factory of each imports what it needs."""
    from droidw_plugins.exporters import depth, ply, trajectory, uncertainty

    yield depth.COMPONENT
    yield ply.COMPONENT
    yield trajectory.COMPONENT
    yield uncertainty.COMPONENT
