"""The guide to each hook is complete, and its example works as it stands."""

from __future__ import annotations

import inspect
import sys
import textwrap
import types

import pytest

import droidw
from droidw.plugin import hookspecs
from droidw.plugin.registry import KINDS, SLOTS


def example(hook):
    """The indented block after `Example::` in the docstring of a hook."""
    text = inspect.getdoc(getattr(hookspecs, hook)).partition("Example::\n")[2]
    lines = []
    for line in text.splitlines():
        if line.strip() and not line.startswith("    "):
            break
        lines.append(line)
    return textwrap.dedent("\n".join(lines))


def test_there_is_one_hook_per_kind():
    hooks = {name for name in dir(hookspecs) if name.startswith("droidw_")}
    assert hooks == {kind.hook for kind in KINDS.values()}
    assert set(SLOTS) < set(KINDS)


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_the_example_of_a_hook_can_be_registered(kind, monkeypatch):
    module = types.ModuleType(f"example_of_{kind.hook}")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(example(kind.hook), module.__dict__)
    before = droidw.load_plugins(environ={"DROIDW_LOAD_PLUGINS": ""})
    known = set(before.registry(kind.name))
    after = droidw.register(module, to=before)
    assert len(set(after.registry(kind.name)) - known) == 1


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_the_guide_names_protocol_and_conformance_suite(kind):
    from droidw.testing import conformance

    guide = inspect.getdoc(getattr(hookspecs, kind.hook))
    assert "droidw.interfaces." in guide
    suites = [name for name in dir(conformance) if name.startswith("check_")]
    assert [name for name in suites if name in guide]
