"""The built-in depth priors, offered through the entry-point group `droidw`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from droidw.plugin.component import Component
from droidw.plugin.hookspecs import hookimpl

if TYPE_CHECKING:
    from droidw.interfaces.depth import DepthPrior

__all__ = ["droidw_depth_priors"]


@hookimpl
def droidw_depth_priors() -> Iterable[Component[DepthPrior]]:
    """Light records only: the factory of each imports what it needs."""
    from droidw_plugins.depth import file, metric3d, none

    yield file.COMPONENT
    yield metric3d.COMPONENT
    yield none.COMPONENT
