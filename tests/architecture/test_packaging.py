"""pyproject.toml against the folders on disk and against what is installed."""

from __future__ import annotations

import re
import sys
from importlib import metadata, resources
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def _listed_packages():
    text = (ROOT / "pyproject.toml").read_text()
    block = re.search(r"^packages = \[(.*?)^\]", text, re.DOTALL | re.MULTILINE)
    return set(re.findall(r'"([\w.]+)"', block[1]))


def test_every_package_is_listed():
    found = {"droidw.configs"}
    for base, package in ((ROOT, "droidw"), (ROOT / "plugins", "droidw_plugins")):
        for init in (base / package).rglob("__init__.py"):
            found.add(".".join(init.parent.relative_to(base).parts))
    assert _listed_packages() == found


def test_versions_agree():
    import droidw

    version = re.search(r'^version = "(.*)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert droidw.__version__ == version[1]
    assert f"[{version[1]}]" in (ROOT / "CHANGELOG.md").read_text()
    assert f"version: {version[1]}" in (ROOT / "CITATION.cff").read_text()


def test_every_dependency_is_pinned():
    """What `make` installs is the same on every day."""
    text = (ROOT / "pyproject.toml").read_text()
    block = re.search(r"^dependencies = \[(.*?)^\]", text, re.DOTALL | re.MULTILINE)[1]
    wanted = set(re.findall(r'"([\w-]+)', block))
    pinned = set(re.findall(r"^([\w-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    assert wanted - pinned == set()


def test_configs_are_a_resource():
    try:
        metadata.distribution("droidw")
    except metadata.PackageNotFoundError:
        pytest.skip("droidw runs from a source tree here, so droidw.configs is not mapped")
    names = [entry.name for entry in resources.files("droidw.configs").iterdir()]
    assert "base.yaml" in names
    presets = [
        entry.name for entry in resources.files("droidw.configs").joinpath("presets").iterdir()
    ]
    assert "cpu.yaml" in presets


def test_python_is_one_that_we_promise():
    assert (3, 10) <= sys.version_info[:2] <= (3, 13)
