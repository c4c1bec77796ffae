"""Distributions that are only folders on `sys.path`: discovery is tested without pip."""

from __future__ import annotations

from pathlib import Path

import pytest

DATA = Path(__file__).parent / "data"


@pytest.fixture
def acme(monkeypatch):
    """One distribution with a sound plugin and one for every way to be broken."""
    monkeypatch.syspath_prepend(str(DATA / "acme"))


@pytest.fixture
def other(monkeypatch):
    """A second distribution whose only part has a name that `acme` has, too."""
    monkeypatch.syspath_prepend(str(DATA / "other"))
