"""The exporters keep what `droidw.testing` asks of every exporter."""

from __future__ import annotations

import pytest

from droidw.testing.conformance import check_exporter
from droidw_plugins.exporters import ply, trajectory


@pytest.mark.parametrize("component", [ply.COMPONENT, trajectory.COMPONENT], ids=lambda c: c.name)
def test_conformance(component):
    check_exporter(component)
