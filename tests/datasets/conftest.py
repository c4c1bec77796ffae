"""The maker of small videos, as a fixture: test folders are not packages."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def videos():
    path = Path(__file__).parents[1] / "io" / "made_up_video.py"
    spec = importlib.util.spec_from_file_location("made_up_video", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
