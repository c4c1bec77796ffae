"""Exporters: files out of a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from droidw.slam.frame import RunResult

__all__ = ["Exporter"]


@runtime_checkable
class Exporter(Protocol):
    """Writes a result in one format."""

    def export(self, result: RunResult, folder: Path) -> list[Path]:
        """Write into `folder` (which exists), and return the files written."""
        ...
