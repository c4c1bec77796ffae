"""Fields of the configuration."""

from __future__ import annotations

from dataclasses import field
from typing import Any

__all__ = ["opt"]


def opt(default: Any, help: str, **limits: Any) -> Any:
    """A dataclass field with help text and limits (`ge`, `gt`, `le`, `lt`)."""
    metadata = {"help": help, **limits}
    if isinstance(default, (list, dict)):
        value = default
        return field(default_factory=lambda: type(value)(value), metadata=metadata)
    return field(default=default, metadata=metadata)
