"""Keys that sections have alike, and that nothing reads in some of them."""

from __future__ import annotations

from droidw.config.load import LoadedConfig
from droidw.config.schema import DroidwConfig
from droidw.errors import ConfigError

__all__ = ["INERT", "check_inert"]

INERT = {
    "schedule.global.updates": "how many there are is set by backend.passes",
    "schedule.fill.updates": "how many there are is set by filler.updates",
    "schedule.fill.learn": "nothing is learned from frames between keyframes",
    "schedule.fill.depth_prior": "no depth is looked for between keyframes",
    "filler_solver.depth_damping": "no depth is looked for between keyframes",
    "filler_solver.planes": "no depth is looked for between keyframes",
    "filler_solver.guard": "each frame between keyframes is adjusted by itself",
}
"""Full key -> why it changes nothing."""


def check_inert(config: DroidwConfig, loaded: LoadedConfig) -> None:
    """Refuse a value other than the default where it would change nothing.

    Raises:
        ConfigError: with the reason.
    """
    usual = DroidwConfig()
    for key, why in INERT.items():
        if _value(config, key) not in (_value(usual, key), None):
            raise ConfigError(f"{loaded.at(key)}: this key changes nothing", f"{why}; leave it out")


def _value(config: object, key: str) -> object:
    """The value of a full key; None in a phase that was taken out."""
    for name in key.split("."):
        config = config.get(name) if isinstance(config, dict) else getattr(config, name, None)
    return config
