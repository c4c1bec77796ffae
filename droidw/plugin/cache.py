"""Where a user's cache of droidw lies."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

__all__ = ["user_cache"]


def user_cache(environ: Mapping[str, str]) -> Path:
    """`$XDG_CACHE_HOME/droidw`, else `~/.cache/droidw`."""
    cache = environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache else Path.home() / ".cache") / "droidw"
