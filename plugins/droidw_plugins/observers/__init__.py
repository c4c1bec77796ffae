"""The built-in observers, offered through the entry-point group `droidw`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from droidw.plugin.component import Component
from droidw.plugin.hookspecs import hookimpl

if TYPE_CHECKING:
    from droidw.interfaces.observers import Observer

__all__ = ["droidw_observers"]


@hookimpl
def droidw_observers() -> Iterable[Component[Observer]]:
    """Light records only: the factory of each imports what it needs."""
    from droidw_plugins.observers import progress, report

    yield progress.COMPONENT
    yield report.COMPONENT
