"""The built-in uncertainty models, offered through the entry-point group `droidw`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from droidw.plugin.component import Component
from droidw.plugin.hookspecs import hookimpl

if TYPE_CHECKING:
    from droidw.interfaces.uncertainty import UncertaintyModel

__all__ = ["droidw_uncertainty_models"]


@hookimpl
def droidw_uncertainty_models() -> Iterable[Component[UncertaintyModel]]:
    """Light records only: the factory of each imports what it needs."""
    from droidw_plugins.uncertainty import affine_softplus, mlp, none, per_pixel

    yield affine_softplus.COMPONENT
    yield per_pixel.COMPONENT
    yield mlp.COMPONENT
    yield none.COMPONENT
