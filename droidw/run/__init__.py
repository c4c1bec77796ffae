"""One run: folder, device, parts, frames in, files out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from droidw.run.drive import run

__all__ = ["run"]


def __getattr__(name: str) -> Any:
    """Import what runs when it is asked for: signals and folders need no torch."""
    if name == "run":
        from droidw.run.drive import run

        return run
    raise AttributeError(f"module 'droidw.run' has no attribute {name!r}")
