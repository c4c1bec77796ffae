"""Makers of small videos and of small datasets, as fixtures: test folders are not packages."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest


def _module(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def videos():
    return _module(Path(__file__).parents[1] / "io" / "made_up_video.py")


@pytest.fixture(scope="session")
def trees():
    return _module(Path(__file__).with_name("trees.py"))


@pytest.fixture
def data(tmp_path, monkeypatch):
    """The folder of datasets."""
    monkeypatch.setenv("DROIDW_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.fixture
def context():
    """What a run hands to factories; `published` asks for the published behaviour."""
    import torch

    from droidw.plugin.component import BuildContext

    def make(published=False, data_dir=None):
        compat = frozenset({"droid-w"} if published else ())
        return BuildContext(torch.device("cpu"), compat=compat, data_dir=data_dir)

    return make
