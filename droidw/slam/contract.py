"""What parts answer while they run, held to the protocol of their kind."""

from __future__ import annotations

from droidw.errors import PluginError
from droidw.interfaces.uncertainty import UncertaintyReport

__all__ = ["energy_of"]


def energy_of(report: object) -> float:
    """The energy that an uncertainty model reports of an update.

    Raises:
        PluginError: it is no report.
    """
    if not isinstance(report, UncertaintyReport):
        raise PluginError(
            "the uncertainty model breaks its contract: `update` returned "
            f"{type(report).__name__}, no UncertaintyReport",
            "return droidw.interfaces.uncertainty.UncertaintyReport(energy=...); the checks in "
            "droidw.testing find more (docs/plugins.md)",
        )
    return report.energy
