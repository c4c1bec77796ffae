"""Three ways in, isolation of broken plugins, load and block lists."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import types
from importlib import metadata

import pytest

import droidw
from droidw.errors import MissingRequirementError, PluginError, UsageError, nearest
from droidw.plugin.checks import problem_of
from droidw.plugin.registry import KINDS, PluginNotFound

SOUND = """
from __future__ import annotations
from dataclasses import dataclass
import droidw

@dataclass(frozen=True)
class Options:
    sizes: tuple[int, ...] = (1,)

@droidw.hookimpl
def droidw_exporters():
    yield droidw.Component("mine", "my exporter", lambda options, context: options, Options)
"""


def component(name="mine", **changes):
    return droidw.Component(name, "a part", lambda options, context: None, **changes)


def failure(plugins, name):
    (found,) = [f for f in plugins.failures if f.name == name]
    return found


def test_builtins_come_through_the_entry_points():
    plugins = droidw.load_plugins(environ={"DROIDW_LOAD_PLUGINS": ""})
    for kind in KINDS:
        registry = plugins.registry(kind)
        assert len(registry) > 0, f"{kind}: {plugins.failures}"
        assert all(registry.entry(name).distribution == "droidw" for name in registry)
    assert plugins.failures == []


def test_an_installed_distribution_is_found_with_its_provenance(acme):
    registry = droidw.load_plugins(environ={}).registry("features")
    entry = registry.entry("acme")
    assert (entry.plugin, entry.origin) == ("acme-good", "droidw-acme 1.2")
    assert registry.status("acme") == "ready"
    assert registry.require("acme") is entry.component


def test_broken_import_is_listed_and_harms_nobody(acme):
    plugins = droidw.load_plugins(environ={})
    found = failure(plugins, "acme-depth")
    assert found.origin == "droidw-acme 1.2"
    assert found.error == ("ModuleNotFoundError: No module named 'acme_net_that_is_not_there'")
    assert "acme_import_error.py" in found.traceback
    assert "cnn" in plugins.registry("features")
    with pytest.raises(PluginError) as caught:
        plugins.registry("depth").get("acme-depth")
    assert str(caught.value) == (
        "plugin 'acme-depth' of droidw-acme 1.2 failed to load: "
        "ModuleNotFoundError: No module named 'acme_net_that_is_not_there'\n"
        "  see: droidw list-plugins --traceback acme-depth"
    )


def test_unknown_hook_is_refused_with_the_nearest(acme):
    assert failure(droidw.load_plugins(environ={}), "acme-typo").error == (
        "unknown hook 'droidw_uncertanty_models'; did you mean 'droidw_uncertainty_models'?"
    )


def test_wrong_return_type_is_refused(acme):
    assert failure(droidw.load_plugins(environ={}), "acme-type").error == (
        "droidw_exporters: yielded a dict ({'name': 'acme-csv'}) where a droidw.Component is "
        "expected"
    )


def test_other_ways_to_be_broken(acme):
    plugins = droidw.load_plugins(environ={})
    assert failure(plugins, "acme-raises").error == "RuntimeError: no licence key"
    assert "marked with @droidw.hookimpl" in failure(plugins, "acme-empty").error
    assert "folder" in failure(plugins, "acme-arguments").error
    assert len(plugins.failures) == 6


def test_strict_raises_the_first_failure(acme):
    with pytest.raises(PluginError, match=r"\(droidw-acme 1.2\) failed to load"):
        droidw.load_plugins(environ={}, strict=True)


def test_name_clash_names_both_distributions(acme, other):
    plugins = droidw.load_plugins(environ={})
    registry = plugins.registry("features")
    assert registry.status("acme") == "name clash: droidw-acme 1.2, droidw_other 0.3"
    with pytest.raises(PluginError) as caught:
        registry.get("acme")
    assert str(caught.value) == (
        "the feature extractor 'acme' is offered by droidw-acme 1.2 (plugin 'acme-good') and by "
        "droidw_other 0.3 (plugin 'other'); a name must be unique within its kind\n"
        "  switch one off: DROIDW_DISABLE_PLUGINS=other"
    )
    settled = droidw.load_plugins(environ={"DROIDW_DISABLE_PLUGINS": "other"})
    assert settled.registry("features").entry("acme").origin == "droidw-acme 1.2"


@dataclasses.dataclass(frozen=True)
class _Unreadable:
    helped: int = dataclasses.field(default=1, metadata={"help": None})


@dataclasses.dataclass(frozen=True)
class _Refused:
    count: int = 0

    def __post_init__(self):
        raise ValueError("never")


@dataclasses.dataclass(frozen=True)
class _Unknown:
    path: "Nowhere" = None  # noqa: F821, UP037


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"name": 5}, "the name 5 is not lower-case kebab"),
        ({"summary": None}, "summary is None, not one line of text"),
        ({"summary": "slow,\nbut sure"}, "not one line of text"),
        ({"options": _Unreadable}, "the help of 'helped' is None, not text"),
        ({"options": _Refused}, "its defaults are refused: ValueError: never"),
        ({"options": _Unknown}, "a type cannot be looked up"),
    ],
)
def test_records_that_would_break_lists_for_all_are_refused(changes, said):
    assert said in problem_of(dataclasses.replace(component(), **changes))


def test_a_hook_that_raises_is_told_as_it_says(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "import droidw\n@droidw.hookimpl\ndef droidw_depth_priors():\n"
        "    raise ValueError('no sensor')\n"
    )
    with pytest.raises(PluginError, match="ValueError: no sensor"):
        droidw.load_plugins([file])


def leave():
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("available", "said"),
    [
        (lambda: True, "its check returned True, not why it cannot run"),
        (lambda: None, "its check returned None"),
        (leave, "its check raised SystemExit: 3"),
    ],
)
def test_checks_that_answer_no_text(available, said):
    plugins = droidw.register(features=component(available=available))
    assert said in plugins.registry("features").status("mine")
    with pytest.raises(MissingRequirementError, match="cannot run here: its check"):
        plugins.registry("features").require("mine")


def test_what_comes_with_droidw_is_not_what_to_switch_off_at_a_clash(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "import droidw\n@droidw.hookimpl\ndef droidw_depth_priors():\n"
        "    yield droidw.Component('file', 'mine', lambda o, c: None)\n"
    )
    with pytest.raises(PluginError, match="'file' is offered by") as caught:
        droidw.load_plugins([file]).registry("depth").get("file")
    assert "DROIDW_DISABLE_PLUGINS" not in caught.value.hint
    assert "give it another name" in caught.value.hint


def test_strict_raises_on_a_clash():
    plugins = droidw.register(features=component("twin"))
    plugins.add("features", component("twin"))
    plugins.failures.clear()
    with pytest.raises(PluginError, match="'twin' is offered by"):
        plugins.check()


@pytest.mark.parametrize("name", ["none", "features/none"])
def test_blocked_component(name):
    plugins = droidw.load_plugins(environ={"DROIDW_DISABLE_PLUGINS": f" {name} ,"})
    registry = plugins.registry("features")
    assert registry.status("none") == "switched off"
    with pytest.raises(MissingRequirementError, match="switched off by DROIDW_DISABLE_PLUGINS"):
        registry.require("none")
    blocked_elsewhere = plugins.registry("uncertainty").status("none") == "switched off"
    assert blocked_elsewhere == (name == "none")


@pytest.mark.parametrize("name", ["acme-good", "droidw-acme", "Droidw_Acme"])
def test_blocked_plugin_and_distribution(acme, name):
    plugins = droidw.load_plugins(environ={"DROIDW_DISABLE_PLUGINS": name})
    assert "acme" not in plugins.registry("features")
    assert "cnn" in plugins.registry("features")


@pytest.mark.parametrize(
    ("wanted", "loaded"),
    [("", set()), ("droidw_acme", {"droidw-acme"}), ("droidw-other", {"droidw_other"}),
     (None, {"droidw-acme", "droidw_other"})],
)  # fmt: skip
def test_load_list_limits_third_parties_only(acme, other, wanted, loaded):
    environ = {} if wanted is None else {"DROIDW_LOAD_PLUGINS": wanted}
    plugins = droidw.load_plugins(environ=environ)
    assert {e.distribution for e in plugins.entries()} == {"droidw"} | loaded


def test_names_in_the_lists_that_mean_nothing_are_reported(caplog):
    environ = {"DROIDW_LOAD_PLUGINS": "droidw-gone", "DROIDW_DISABLE_PLUGINS": "cnn,cmn"}
    droidw.load_plugins(environ=environ)
    assert caplog.messages == [
        "DROIDW_LOAD_PLUGINS: no installed distribution 'droidw-gone' offers plugins",
        "DROIDW_DISABLE_PLUGINS: nothing is called 'cmn'",
    ]


def test_missing_extra_says_what_to_install(acme):
    registry = droidw.load_plugins(environ={}).registry("depth")
    assert registry.status("acme-extra") == "needs droidw-acme[net]"
    with pytest.raises(MissingRequirementError) as caught:
        registry.require("acme-extra")
    assert str(caught.value) == (
        "'acme-extra' is registered but cannot run: Python package 'acme_net' is missing\n"
        "  install it: pip install 'droidw-acme[net]'\n"
        "  or run without: depth=none"
    )
    assert caught.value.exit_code == 5


def test_other_things_that_can_be_missing(acme, tmp_path):
    registry = droidw.load_plugins(environ={"DROIDW_WEIGHTS": str(tmp_path)}).registry("depth")
    assert registry.status("acme-package") == "needs acme_net"
    assert registry.status("acme-weights") == "weights missing: acme.pth"
    with pytest.raises(MissingRequirementError, match=f"'acme.pth' are not in {tmp_path}"):
        registry.require("acme-weights")
    (tmp_path / "acme.pth").touch()
    assert registry.status("acme-weights") == "ready"
    assert registry.status("acme-gpu") == "no GPU visible"
    with pytest.raises(MissingRequirementError, match="cannot run here: no GPU visible"):
        registry.require("acme-gpu")
    assert registry.status("acme-odd") == "its check raised ZeroDivisionError: division by zero"


def test_unknown_name_gets_the_nearest_and_the_list():
    registry = droidw.load_plugins(environ={"DROIDW_LOAD_PLUGINS": ""}).registry("features")
    with pytest.raises(PluginNotFound) as caught:
        registry.get("cn")
    assert str(caught.value) == (
        "no feature extractor is called 'cn'\n"
        f"  did you mean 'cnn'?   available: {', '.join(registry.names())}\n"
        "  see: droidw list-plugins --kind features"
    )
    assert caught.value.exit_code == 5


def test_only_what_is_really_near_is_suggested():
    kinds = {kind: droidw.load_plugins(environ={}).registry(kind).names() for kind in KINDS}
    for kind, name, near in (
        ("depth", "affine", ""), ("uncertainty", "affine", "affine-softplus"),
        ("uncertainty", "afine-softplus", "affine-softplus"), ("uncertainty", "pixel", "per-pixel"),
        ("features", "dino", "dinov2"), ("depth", "metric3d-large", "metric3d"),
        ("exporter", "plx", "ply"), ("reader", "file", ""), ("ba", "nothing", ""),
    ):  # fmt: skip
        assert nearest(name, kinds[kind]) == near, (kind, name)


def test_unknown_kind():
    with pytest.raises(UsageError, match="there is no kind of plugin called 'feature'"):
        droidw.load_plugins(environ={}).registry("feature")


def test_file_plugin(tmp_path):
    path = tmp_path / "my plugin.py"
    path.write_text(SOUND)
    entry = droidw.load_plugins([path], environ={}).registry("exporter").entry("mine")
    assert (entry.plugin, entry.origin) == ("my plugin", str(path))
    assert entry.component.options().sizes == (1,)


def test_file_plugin_that_is_broken_was_asked_for(tmp_path):
    path = tmp_path / "bad.py"
    path.write_text("1 / 0")
    before = set(sys.modules)
    with pytest.raises(PluginError, match=r"'bad' .* failed to load: ZeroDivisionError") as caught:
        droidw.load_plugins([path], environ={})
    assert caught.value.hint == f"see: droidw list-plugins --plugin {path} --traceback bad"
    assert not [name for name in set(sys.modules) - before if "droidw_plugin" in name]
    assert failure(droidw.load_plugins([path], environ={}, tolerant=True), "bad").traceback
    with pytest.raises(UsageError, match="there is no such file"):
        droidw.load_plugins([tmp_path / "gone.py"], environ={})
    other = tmp_path / "plugin.txt"
    other.write_text(SOUND)
    with pytest.raises(PluginError, match=r"must end in \.py"):
        droidw.load_plugins([other], environ={})
    with pytest.raises(UsageError, match="this is a folder") as error:
        droidw.load_plugins([tmp_path], environ={})
    assert "pip install" in error.value.hint


def test_a_plugin_that_exits_is_only_broken(tmp_path):
    path = tmp_path / "leave.py"
    path.write_text("raise SystemExit(3)")
    plugins = droidw.load_plugins([path], environ={}, tolerant=True)
    assert failure(plugins, "leave").error == "SystemExit: 3"


def test_register_from_python(monkeypatch):
    module = types.ModuleType("my_parts")
    monkeypatch.setitem(sys.modules, "my_parts", module)
    exec(SOUND, module.__dict__)
    plugins = droidw.register(module, features=component("quick"))
    assert plugins.registry("exporter").entry("mine").origin == "registered from Python"
    assert "quick" in plugins.registry("features")
    assert "quick" not in droidw.load_plugins().registry("features")  # nothing is kept elsewhere
    assert droidw.register(depth=component("more"), to=plugins) is plugins
    with pytest.raises(PluginError, match="registered already"):
        plugins.register(module)


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (component("Not Kebab"), "the name 'Not Kebab' is not lower-case kebab"),
        (component(options=dict), "options is a type"),
        (component(requires="torch"), "requires is 'torch', not a collection"),
        (component(requires=None), "requires is None, not a collection"),
        (droidw.Component("mine", "", None), "factory is nothing"),
        (42, "yielded a int"),
    ],
)
def test_components_are_checked(part, words):
    with pytest.raises(PluginError, match=words):
        droidw.register(features=part)


def test_hook_that_returns_no_collection():
    class Plugin:
        @droidw.hookimpl
        def droidw_observers(self):
            return component()

    with pytest.raises(PluginError, match=r"it must yield Component records"):
        droidw.register(Plugin())

    class Twice:
        @droidw.hookimpl
        def droidw_observers(self):
            return [component(), component()]

    with pytest.raises(PluginError, match="yielded two components called 'mine'"):
        droidw.register(Twice())


def test_bare_source_tree_says_so(monkeypatch):
    monkeypatch.setattr(metadata, "entry_points", lambda group: ())
    plugins = droidw.load_plugins(environ={})
    (found,) = plugins.failures
    assert found.error == (
        "droidw runs from a bare source tree, so its own plugins are not registered; "
        "install it: pip install -e ."
    )
    with pytest.raises(PluginNotFound, match="bare source tree"):
        plugins.registry("features").get("cnn")


def test_listing_plugins_loads_nothing_heavy():
    code = (
        "import sys, droidw; p = droidw.load_plugins();"
        "print([m for m in ('torch', 'cv2', 'av', 'kornia') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
