"""README and the pages beside it: links lead somewhere, commands and keys exist."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
README = (ROOT / "README.md").read_text(encoding="utf-8")


def _shell_lines():
    """Commands of all shell blocks of the README, without their remarks."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines() if line.strip()]
    return [shlex.split(line, comments=True) for line in lines]


def _anchors(text):
    """What GitHub makes of the headings of a page."""
    plain = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", plain, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


FOLDERS = ("docs", "benchmarks", "examples", "plugins")
LINKING = sorted([*ROOT.glob("*.md"), *(p for f in FOLDERS for p in (ROOT / f).rglob("*.md"))])


@pytest.mark.parametrize("page", LINKING, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name) if name else page
        assert target.exists(), f"{page}: {link}: there is no such file"
        if anchor and target.suffix == ".md":
            found = _anchors(target.read_text(encoding="utf-8"))
            assert anchor in found, f"{page}: {link}: there is no such heading"


def test_the_two_commands_come_first():
    assert _shell_lines()[:2] == [["make", "demo"], ["make", "test"]]


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    for page in PAGES:
        for target in re.findall(r"\bmake ([a-z]+)\b(?=[`\s]*(?:#|`|$))", page.read_text()):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{page.name}: make {target}"


def test_blocks_for_ci_are_found():
    done = subprocess.run(
        [sys.executable, str(ROOT / ".ci" / "readme_commands.py"), str(ROOT / "README.md")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "droidw run clip.mp4" in done.stdout
    assert "make" not in done.stdout


def _commands():
    return sorted({" ".join(words[:2]) for words in _shell_lines() if words[0] == "droidw"})


@pytest.mark.parametrize("command", _commands())
def test_commands_and_options_exist(command):
    verb = command.split()[1]
    done = subprocess.run(
        [sys.executable, "-m", "droidw", verb, "-h"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for words in _shell_lines():
        if words[:2] == ["droidw", verb]:
            for option in (word for word in words[2:] if word.startswith("-")):
                assert re.search(rf"(^|[\s,]){option}\b", done.stdout), f"{verb} has no {option}"


def test_keys_exist():
    """Every `key=value` of a droidw command in the README names a key of the configuration."""
    from droidw.config.schema import DroidwConfig

    for words in _shell_lines():
        if words[:2] != ["droidw", "run"]:
            continue
        for key in (word.split("=")[0] for word in words[3:] if re.match(r"[a-z_.]+=", word)):
            node = DroidwConfig()
            for part in key.split("."):
                assert hasattr(node, part), f"README: there is no key {key}"
                node = getattr(node, part)


def test_environment_variables_are_real():
    files = [*(ROOT / "droidw").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")]
    sources = "".join(p.read_text() for p in files)
    for page in PAGES:
        for name in set(re.findall(r"\bDROIDW_[A-Z_]+\b", page.read_text())):
            assert name in sources, f"{page.name}: {name}"
