"""The built-in bundle adjustment backends, offered through the entry-point group `droidw`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from droidw.plugin.component import Component
from droidw.plugin.hookspecs import hookimpl

if TYPE_CHECKING:
    from droidw.interfaces.bundle import BundleAdjuster

__all__ = ["droidw_ba_backends"]


@hookimpl
def droidw_ba_backends() -> Iterable[Component[BundleAdjuster]]:
    """Light records only: the factory of each imports what it needs."""
    from droidw_plugins.bundle import auto_ba, cuda_ba, native_ba, torch_ba

    yield auto_ba.COMPONENT
    yield cuda_ba.COMPONENT
    yield native_ba.COMPONENT
    yield torch_ba.COMPONENT
