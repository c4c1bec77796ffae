"""The built-in correspondence operators, offered through the entry-point group `droidw`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from droidw.plugin.component import Component
from droidw.plugin.hookspecs import hookimpl

if TYPE_CHECKING:
    from droidw.interfaces.correspondence import Correspondence

__all__ = ["droidw_correspondence_ops"]


@hookimpl
def droidw_correspondence_ops() -> Iterable[Component[Correspondence]]:
    """Light records only: the factory of each imports what it needs."""
    from droidw_plugins.correspondence import droid, flow, synthetic

    yield droid.COMPONENT
    yield flow.COMPONENT
    yield synthetic.COMPONENT
