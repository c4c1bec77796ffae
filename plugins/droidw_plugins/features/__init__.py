"""The built-in feature extractors, offered through the entry-point group `droidw`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from droidw.plugin.component import Component
from droidw.plugin.hookspecs import hookimpl

if TYPE_CHECKING:
    from droidw.interfaces.features import FeatureExtractor

__all__ = ["droidw_feature_extractors"]


@hookimpl
def droidw_feature_extractors() -> Iterable[Component[FeatureExtractor]]:
    """Light records only: the factory of each imports what it needs."""
    from droidw_plugins.features import cnn, dinov2, fit3d, none

    yield cnn.COMPONENT
    yield dinov2.COMPONENT
    yield fit3d.COMPONENT
    yield none.COMPONENT
