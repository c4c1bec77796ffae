"""The compiled backend: threads, building, the cache, and what `auto` makes of it."""

from __future__ import annotations

import logging
import stat
from dataclasses import replace

import pytest
import torch

from droidw.errors import MissingRequirementError
from droidw.plugin.component import BuildContext
from droidw.plugin.manager import load_plugins
from droidw_plugins.bundle import _build, _kernel_calls, _native_calls, auto_ba, native_ba
from droidw_plugins.bundle._native_calls import native_recipe

CPU = BuildContext(device=torch.device("cpu"))


@pytest.fixture
def compiler():
    if native_recipe() is None:
        pytest.skip("no C++ compiler here")


@pytest.fixture
def broken_compiler(tmp_path, monkeypatch):
    """A compiler that only complains, and an empty cache."""
    fake = tmp_path / "bad-c++"
    fake.write_text(
        "#!/bin/sh\n[ \"$1\" = --version ] && exit 0\necho 'kaput: line 7' >&2\nexit 1\n"
    )
    fake.chmod(fake.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("CXX", str(fake))
    monkeypatch.setenv(_build.CACHE_VARIABLE, str(tmp_path / "cache"))


@pytest.mark.parametrize("launcher", ["ccache", "sccache"])
def test_what_launches_the_compiler_is_none(compiler, monkeypatch, launcher):
    found = native_recipe().compiler
    monkeypatch.setenv("CXX", f"{launcher} {found} -O2")
    assert native_recipe().compiler == found


def test_a_compiler_that_is_no_program_is_told_of(compiler, monkeypatch, tmp_path):
    monkeypatch.setenv(_build.CACHE_VARIABLE, str(tmp_path))
    odd = tmp_path / "odd-c++"
    odd.write_bytes(b"\x7fELF of another machine")
    odd.chmod(0o755)
    recipe = replace(native_recipe(), compiler=str(odd))
    with pytest.raises(_build.BuildError, match=r"could not compile the kernels(.|\n)*Exec format"):
        _build.build(recipe)
    assert _kernel_calls.known_architectures(str(odd)) == []


def test_the_number_of_threads_changes_no_byte(make, compiler):
    p, _, _ = make(n=6, h=30, w=40, noise=0.02, dtype=torch.float32, guard=True, huber=0.3)
    one, three = (
        native_ba.NativeBundleAdjuster(native_ba.NativeBundleOptions(threads=n)).step(p)
        for n in (1, 3)
    )
    assert one.report.status == "ok"
    assert one.report == three.report
    assert torch.equal(one.T_cw, three.T_cw)
    assert torch.equal(one.disps, three.disps)


@pytest.mark.parametrize(
    "change",
    [
        {"ii": torch.tensor([9])},
        {"jj": torch.tensor([-1])},
        {"fixed": torch.zeros(2, dtype=torch.bool)},
        {"damping": torch.zeros(5, 3, 3)},
    ],
    ids=lambda c: next(iter(c)),
)
def test_what_would_be_read_out_of_bounds_is_refused(make, compiler, change):
    p, _, _ = make()
    name, value = next(iter(change.items()))
    if name in ("ii", "jj"):
        value = torch.cat((getattr(p, name)[:-1], value))
    with pytest.raises(ValueError, match=name):
        native_ba.NativeBundleAdjuster().step(replace(p, **{name: value}))


def test_the_library_is_built_once_and_found_again(compiler, monkeypatch, tmp_path):
    monkeypatch.setenv(_build.CACHE_VARIABLE, str(tmp_path))  # nobody else compiles there
    recipe = replace(native_recipe(), attempts=(("-std=c++17", "-O0", "-shared", "-fPIC"),))
    first = _build.build(recipe)
    made = first.stat().st_mtime_ns
    assert first.parent == _build.kernels_dir()
    assert _build.build(recipe) == first
    assert first.stat().st_mtime_ns == made
    assert not list(first.parent.glob("build-*"))


def test_another_compiler_flag_or_processor_is_another_library(compiler):
    recipe = native_recipe()
    keys = {
        recipe.key,
        replace(recipe, version="other").key,
        replace(recipe, target="other").key,
        replace(recipe, attempts=(("-O0",),)).key,
    }
    assert len(keys) == 4


def test_the_cache_goes_where_the_variables_say():
    assert str(_build.kernels_dir({"DROIDW_CACHE": "/a"})) == "/a/kernels"
    assert str(_build.kernels_dir({"XDG_CACHE_HOME": "/b"})) == "/b/droidw/kernels"
    assert _build.kernels_dir({}).parts[-3:] == (".cache", "droidw", "kernels")


def test_a_library_is_of_one_kind_of_number(make, compiler, monkeypatch, tmp_path):
    monkeypatch.setenv(_build.CACHE_VARIABLE, str(tmp_path))
    monkeypatch.setattr(_native_calls, "_PLAIN", ("-std=c++17", "-O0", "-shared", "-fPIC"))
    adjuster = native_ba.NativeBundleAdjuster()
    p, _, _ = make(noise=0.02, dtype=torch.float32)
    adjuster.step(p)
    assert [path.name.rpartition("-")[0] for path in _libraries()] == ["native"]
    p, _, _ = make(noise=0.02)
    assert adjuster.step(p).disps.dtype == torch.float64
    assert sorted(path.name.rpartition("-")[0] for path in _libraries()) == [
        "native",
        "native-float64",
    ]


def _libraries():
    return list(_build.kernels_dir().glob(f"*{_build._suffix()}"))


def test_a_failing_compiler_is_quoted_with_a_way_out(broken_compiler):
    assert native_ba.COMPONENT.available() == ""  # not tried yet
    with pytest.raises(MissingRequirementError) as caught:
        native_ba.COMPONENT.factory(native_ba.NativeBundleOptions(), CPU)
    assert "kaput: line 7" in str(caught.value)
    assert "ba=torch" in str(caught.value)
    assert "kaput: line 7" in native_ba.COMPONENT.available()


def test_without_a_compiler_the_backend_says_so(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    assert native_ba.COMPONENT.available() == "no C++ compiler (g++ or clang)"
    with pytest.raises(MissingRequirementError, match=r"g\+\+"):
        native_ba.COMPONENT.factory(native_ba.NativeBundleOptions(), CPU)


def test_auto_takes_native_and_says_so(make, compiler, caplog):
    with caplog.at_level(logging.INFO, logger="droidw_plugins"):
        built = auto_ba.COMPONENT.factory(auto_ba.AutoBundleOptions(), CPU)
    assert built.chosen == "native"
    assert "auto takes 'native'" in caplog.text
    p, _, _ = make(noise=0.02)
    expected = native_ba.NativeBundleAdjuster().step(p)
    assert torch.equal(built.step(p).disps, expected.disps)


def test_auto_goes_on_with_torch_where_nothing_compiles(make, broken_compiler, caplog):
    with caplog.at_level(logging.INFO, logger="droidw_plugins"):
        built = auto_ba.COMPONENT.factory(auto_ba.AutoBundleOptions(), CPU)
    assert built.chosen == "torch"
    assert "kaput: line 7" in caplog.text
    p, _, _ = make(noise=0.02)
    assert built.step(p).report.status == "ok"


def test_auto_leaves_out_what_is_switched_off(compiler):
    disabled = load_plugins(environ={"DROIDW_DISABLE_PLUGINS": "ba/native"}).disabled()
    assert disabled == {"ba/native"}
    context = BuildContext(device=torch.device("cpu"), disabled=disabled)
    built = auto_ba.COMPONENT.factory(auto_ba.AutoBundleOptions(), context)
    assert built.chosen == "torch"
    assert "DROIDW_DISABLE_PLUGINS" in built.reason


def test_auto_goes_on_with_torch_where_kernels_compile_but_do_not_run(compiler, monkeypatch):
    def broken(*_):
        raise RuntimeError("no kernel image is available")

    monkeypatch.setattr(native_ba.NativeBundleAdjuster, "step", broken)
    built = auto_ba.COMPONENT.factory(auto_ba.AutoBundleOptions(), CPU)
    assert built.chosen == "torch"
    assert "no kernel image" in built.reason


def test_a_cache_that_cannot_be_written_is_named(compiler, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv(_build.CACHE_VARIABLE, str(tmp_path / "file"))
    with pytest.raises(_build.BuildError, match="DROIDW_CACHE"):
        _build.build(native_recipe())
