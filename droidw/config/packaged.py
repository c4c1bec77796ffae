"""Configuration files that come with droidw."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from droidw.errors import ConfigError

__all__ = ["packaged_configs", "packaged_in"]


def packaged_configs() -> dict[str, Path]:
    """Files that come with droidw, by the name that `extends` takes: "base", "presets/cpu".

    Raises:
        ConfigError: droidw is not installed, so they cannot be found.
    """
    try:
        root = Path(str(resources.files("droidw.configs")))
    except ModuleNotFoundError as error:
        raise ConfigError(
            "droidw runs from a bare source tree, so its presets are not found",
            "install it: pip install -e .",
        ) from error
    return {
        path.relative_to(root).with_suffix("").as_posix(): path
        for path in sorted(root.rglob("*.yaml"))
    }


def packaged_in(folder: str) -> dict[str, Path]:
    """Those in a folder ("presets", "ablations"), by their names there.

    Raises:
        ConfigError: as `packaged_configs`.
    """
    start = f"{folder}/"
    return {n.removeprefix(start): p for n, p in packaged_configs().items() if n.startswith(start)}
