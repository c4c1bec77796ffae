"""Say what a wheel of droidw lacks; status 1 if anything."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def wanted() -> set[str]:
    """Every module, config and kernel of the checkout, as the wheel names it."""
    names = {str(path.relative_to(ROOT)) for path in (ROOT / "droidw").rglob("*.py")} | {
        "droidw/py.typed",
        "droidw_plugins/py.typed",
    }
    plugins = ROOT / "plugins"
    for pattern in ("*.py", "*.cu", "*.html", "*.css", "*.js"):
        names |= {str(p.relative_to(plugins)) for p in (plugins / "droidw_plugins").rglob(pattern)}
    configs = ROOT / "configs"
    names |= {f"droidw/configs/{p.relative_to(configs)}" for p in configs.rglob("*.yaml")}
    return names | {"droidw/configs/__init__.py"}


def main(wheel: str) -> int:
    """Compare the wheel's files with the checkout's."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        points = next(name for name in names if name.endswith("entry_points.txt"))
        text = archive.read(points).decode()
    missing = sorted(wanted() - names)
    foreign = sorted(n for n in names if n.split("/")[0] in {"tests", "docs", "benchmarks"})
    if missing or foreign or "[droidw]" not in text:
        print(f"{wheel}: missing: {missing}; should not be there: {foreign}; {text}")
        return 1
    print(f"{Path(wheel).name}: {len(names)} files, nothing is missing")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
