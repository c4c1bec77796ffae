"""Observers: who listens to a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from droidw.events import Event

__all__ = ["Observer"]


@runtime_checkable
class Observer(Protocol):
    """Hears typed events (`droidw.events`) and can stop nothing.

    An observer that raises is reported once as a warning and not called again.
    """

    def on_event(self, event: Event) -> None:
        """Called in the thread of the run, in order; must return quickly while tracking."""
        ...
