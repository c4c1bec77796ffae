"""The pages in docs/ say what the code says: hooks, kinds, keys, commands, options, exit codes."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

from droidw import errors, load_plugins
from droidw.cli.main import VERBS, build_parser
from droidw.config.schema import DroidwConfig
from droidw.plugin import manager
from droidw.plugin.registry import KINDS
from droidw.testing import conformance

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def _text(name):
    return (DOCS / name).read_text(encoding="utf-8")


def _section(verb):
    found = re.search(
        rf"^## droidw {verb}\n(.*?)(?=^## )", _text("cli.md"), re.DOTALL | re.MULTILINE
    )
    assert found, f"docs/cli.md has no section 'droidw {verb}'"
    return found[1]


def test_every_page_is_in_the_index():
    index = _text("index.md")
    for page in sorted(DOCS.rglob("*.md")):
        name = page.relative_to(DOCS).as_posix()
        assert name == "index.md" or f"]({name})" in index, f"docs/index.md does not link {name}"


@pytest.mark.parametrize("page", sorted((DOCS / "tutorials").glob("*.md")), ids=lambda p: p.name)
def test_tutorials_use_real_commands(page):
    text = page.read_text(encoding="utf-8")
    verbs = re.findall(r"^\s+droidw ([a-z-]+)", text, re.MULTILINE)
    assert verbs and set(verbs) <= set(VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_of_every_command_is_documented(verb):
    section = _section(verb)
    for action in build_parser(verb, importlib.import_module(VERBS[verb]))._actions:
        for option in action.option_strings:
            if option not in ("-h", "--help"):
                assert re.search(rf"`{option}[ `]", section), f"docs/cli.md: {verb} {option}"


@pytest.mark.parametrize("verb", VERBS)
def test_documented_options_exist(verb):
    parser = build_parser(verb, importlib.import_module(VERBS[verb]))
    known = set(parser._option_string_actions)
    for option in re.findall(r"(?<![\w-])--[a-z][a-z-]+", _section(verb)):
        assert option in known, f"docs/cli.md: {verb} has no {option}"


def test_option_tables_are_current():
    done = subprocess.run(
        [sys.executable, str(DOCS / "make_cli.py"), "--check"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", ["cli.md", "troubleshooting.md"])
def test_exit_codes_are_those_of_the_errors(page):
    table = _text(page).partition("## Exit codes")[2].partition("\n## ")[0]
    rows = set(re.findall(r"^\| ([0-9, ]+) \|", table, re.MULTILINE))
    documented = {int(code) for row in rows for code in row.split(",")}
    raised = {
        error.exit_code
        for _, error in inspect.getmembers(errors, inspect.isclass)
        if issubclass(error, errors.DroidwError)
    }
    assert documented == raised | {0, 130, 143}


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda k: k.name)
def test_every_hook_is_documented_with_a_suite_that_exists(kind):
    row = re.search(rf"^\| `{kind.hook}` \|.*$", _text("plugins.md"), re.MULTILINE)
    assert row, f"docs/plugins.md does not name {kind.hook}"
    suite = re.search(r"`(check_\w+)` \|$", row[0])
    assert suite and callable(getattr(conformance, suite[1]))


def test_documented_hooks_exist():
    named = set(re.findall(r"\bdroidw_[a-z_]+", _text("plugins.md"))) - {"droidw_acme"}
    assert named == {kind.hook for kind in KINDS.values()}


def test_environment_variables_are_documented():
    for name in (manager.LOAD_VARIABLE, manager.DISABLE_VARIABLE, manager.WEIGHTS_VARIABLE):
        assert f"`{name}`" in _text("cli.md") and f"`{name}`" in _text("plugins.md")


def _keys(config, prefix=""):
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value) and type(value).__name__ != "SlotConfig":
            yield from _keys(value, f"{prefix}{field.name}.")
        elif (
            isinstance(value, dict)
            and value
            and dataclasses.is_dataclass(next(iter(value.values())))
        ):
            for name, part in value.items():
                yield from _keys(part, f"{prefix}{field.name}.{name}.")
        else:
            yield prefix + field.name


def test_every_key_of_the_configuration_is_documented():
    text = _text("configuration.md")
    for key in _keys(DroidwConfig()):
        assert f"`{key}`" in text, f"docs/configuration.md lacks {key}"


def test_configuration_page_is_current():
    from droidw.config.describe import markdown

    assert _text("configuration.md") == markdown()


def test_every_built_in_part_is_in_the_list_of_plugins():
    text = (ROOT / "plugins" / "README.md").read_text(encoding="utf-8")
    for entry in load_plugins(environ={"DROIDW_LOAD_PLUGINS": ""}).entries():
        assert f"`{entry.component.name}`" in text, f"plugins/README.md: {entry.component.name}"


def test_the_plugin_of_the_page_works_and_passes_its_suite(tmp_path):
    code = re.findall(r"^```python\n(.*?)^```$", _text("plugins.md"), re.DOTALL | re.MULTILINE)
    assert len(code) == 1
    file = tmp_path / "ramp.py"
    file.write_text(code[0], encoding="utf-8")
    plugins = load_plugins([file], environ={"DROIDW_LOAD_PLUGINS": ""})
    component = plugins.registry("depth").require("ramp")
    conformance.check_depth_prior(component)
    conformance.check_depth_prior(component, options=component.options(near=2.0, far=5.0))


def test_links_outside_docs_lead_somewhere():
    pages = [
        *(DOCS / "tutorials").glob("*.md"),
        ROOT / "plugins" / "README.md",
        ROOT / "benchmarks" / "README.md",
        ROOT / "examples" / "droidw-plugin-template" / "README.md",
    ]
    for page in pages:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page}: {target}"
