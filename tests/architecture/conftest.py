"""The source files of the distribution, parsed once."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Source:
    """A module of ours: dotted name, path, text and syntax tree."""

    module: str
    path: Path
    text: str
    tree: ast.Module

    @property
    def where(self) -> str:
        return str(self.path.relative_to(ROOT))

    def runtime_imports(self) -> list[tuple[int, str]]:
        """(line, dotted name) of all imports, lazy ones too, less those for type checkers."""
        skipped: set[int] = set()
        for node in ast.walk(self.tree):
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
                skipped.update(id(child) for part in node.body for child in ast.walk(part))
        found: list[tuple[int, str]] = []
        for node in ast.walk(self.tree):
            if id(node) in skipped:
                continue
            if isinstance(node, ast.Import):
                found += [(node.lineno, alias.name) for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{self.where}:{node.lineno}: imports are absolute here"
                found += [(node.lineno, f"{node.module}.{alias.name}") for alias in node.names]
        return found


def _parse(base: Path, package: str) -> list[Source]:
    sources = []
    for path in sorted((base / package).rglob("*.py")):
        parts = path.relative_to(base).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text, filename=str(path), feature_version=(3, 10))
        sources.append(Source(module, path, text, tree))
    return sources


@pytest.fixture(scope="session")
def host() -> list[Source]:
    """Modules of `droidw`."""
    return _parse(ROOT, "droidw")


@pytest.fixture(scope="session")
def builtins() -> list[Source]:
    """Modules of `droidw_plugins`."""
    return _parse(ROOT / "plugins", "droidw_plugins")
