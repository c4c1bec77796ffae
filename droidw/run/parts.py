"""Building the parts of a run, each held to the protocol of its kind."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from droidw.errors import PluginError
from droidw.interfaces.bundle import BundleAdjuster
from droidw.interfaces.correspondence import Correspondence
from droidw.interfaces.depth import DepthPrior
from droidw.interfaces.features import FeatureExtractor
from droidw.interfaces.uncertainty import UncertaintyModel
from droidw.plugin.registry import KINDS
from droidw.slam.optimise import Parts

if TYPE_CHECKING:
    from droidw.config.resolve import ResolvedConfig
    from droidw.interfaces.observers import Observer
    from droidw.plugin.component import BuildContext, Component

__all__ = ["build_observers", "build_parts"]

_log = logging.getLogger("droidw.run.drive")

_PROTOCOLS: dict[str, type] = {
    "features": FeatureExtractor,
    "depth": DepthPrior,
    "uncertainty": UncertaintyModel,
    "ba": BundleAdjuster,
    "correspondence": Correspondence,
}

_NEVER_ASKED = {"state_dict", "load_state_dict"}
"""What protocols have for programs that keep models, and no run needs."""


def build_parts(resolved: ResolvedConfig, context: BuildContext) -> Parts:
    """What the factories of the chosen components make.

    Raises:
        PluginError: it lacks something of the protocol of its kind.
    """
    made = {kind: _made(kind, *resolved.parts[kind], context) for kind in _PROTOCOLS}
    return Parts(**made)


def build_observers(
    resolved: ResolvedConfig, context: BuildContext
) -> tuple[list[tuple[str, Observer]], list[str]]:
    """The chosen observers by name, and a sentence of each that could not be made.

    They only look on: one that fails costs nothing but itself.
    """
    made: list[tuple[str, Observer]] = []
    failed: list[str] = []
    for component, options in resolved.observers:
        try:
            made.append((component.name, component.factory(options, context)))
        except (Exception, SystemExit) as error:  # noqa: BLE001 - strangers' code
            _log.debug("observer %s raised", component.name, exc_info=True)
            failed.append(f"observer '{component.name}' failed: {type(error).__name__}: {error}")
    return made, failed


def _made(kind: str, component: Component[Any], options: Any, context: BuildContext) -> Any:
    part, protocol = component.factory(options, context), _PROTOCOLS[kind]
    wanted = {*vars(protocol), *getattr(protocol, "__annotations__", {})} - _NEVER_ASKED
    missing = sorted(n for n in wanted if not n.startswith("_") and not hasattr(part, n))
    if missing:
        raise PluginError(
            f"{KINDS[kind].noun} '{component.name}' breaks its contract: what its factory makes, a "
            f"{type(part).__name__}, has no {', no '.join(missing)}",
            f"{protocol.__module__}.{protocol.__name__} says what it must have, and the checks in "
            "droidw.testing find more (docs/plugins.md)",
        )
    return part
