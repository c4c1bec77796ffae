"""The folder of weights: what gets in, under what name, and what is found out later."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from droidw.errors import InputError, MissingRequirementError, PluginError, UsageError
from droidw.io.download import DownloadError
from droidw.io.weights import find, load_state, read_state
from droidw.io.weights_store import WeightsStore, catalogue, require_shapes
from droidw.plugin.component import Component
from droidw.plugin.registry import Entry
from droidw.plugin.weights import WeightsFile


@pytest.fixture
def acme(monkeypatch, site):
    monkeypatch.setenv("ACME_URL", site.root)
    path = Path(__file__).with_name("acme_weights.py")
    spec = importlib.util.spec_from_file_location("acme_weights", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(__import__("sys").modules, "acme_weights", module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def store(acme, tmp_path):
    (component,) = acme.droidw_depth_priors()
    return WeightsStore(tmp_path / "weights", catalogue([entry(component)]))


def entry(component, distribution="droidw-acme"):
    return Entry("depth", component, "acme", distribution, "1.0")


def weights(**more):
    torch.manual_seed(0)
    bias = torch.randn(4)
    return {"conv.weight": torch.randn(4, 3, 3, 3), "conv.bias": bias, "alias.bias": bias, **more}


def saved(path, state=None, wrap="model_state_dict"):
    state = weights() if state is None else state
    torch.save({wrap: state, "epoch": 7} if wrap else state, path)
    return path


class Evil:
    """Runs a command when it is unpickled by a careless reader."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)


def test_the_catalogue_asks_every_choice_of_options(store):
    assert list(store.known) == ["acme-big", "acme-small"]
    assert store.known["acme-small"].needed_by == ("depth acme",)
    assert store.file("acme_v2.pth").name == "acme-small"
    with pytest.raises(UsageError, match="no weights are called 'acme-smal'") as error:
        store.file("acme-smal")
    assert "did you mean 'acme-small'" in error.value.hint


def test_one_name_means_one_file(acme):
    (component,) = acme.droidw_depth_priors()
    other = replace(component, name="other", weights=(replace(acme.SMALL, size=5),))
    with pytest.raises(PluginError, match="described differently by droidw-acme and by droidw-x"):
        catalogue([entry(component), entry(other, "droidw-x")])
    bare = Component("bare", "", lambda *_: None, weights=("acme-small", "nobody.pth"))
    found = catalogue([entry(bare), entry(component)])
    assert found["acme-small"].file == acme.SMALL and len(found["acme-small"].needed_by) == 2
    assert found["nobody.pth"].file == WeightsFile("nobody.pth")


def test_fetched_checked_and_stored_as_safetensors(store, site, tmp_path):
    data = saved(tmp_path / "x.pth").read_bytes()
    site.serve("/acme_v2.pth", data)
    path, came = store.fetch("acme-small")
    assert came and path.name == "acme-small.safetensors"
    assert sorted(p.name for p in store.folder.iterdir()) == [path.name, "weights.json"]
    state = load_state(store.folder, "acme-small")
    torch.testing.assert_close(state, weights())
    record = json.loads((store.folder / "weights.json").read_text())["acme-small"]
    assert record["published_sha256"] == site.files["/acme_v2.pth"].sha256
    assert record["source"] == f"{site.root}/acme_v2.pth" and record["licence"] == "CC BY-NC 4.0"
    assert store.fetch("acme-small") == (path, False) and len(site.requests) == 1


def test_another_file_at_the_same_address_is_refused(store, site, tmp_path):
    site.serve("/acme_v2.pth", saved(tmp_path / "x.pth").read_bytes())
    path, _ = store.fetch("acme-small")
    before = path.read_bytes()
    other = saved(tmp_path / "y.pth", weights() | {"conv.bias": torch.ones(4)})
    site.serve("/acme_v2.pth", other.read_bytes(), tag='"v2"')
    with pytest.raises(DownloadError, match="not the file that came from there before") as error:
        store.fetch("acme-small", force=True)
    assert "weights.json" in error.value.hint
    assert path.read_bytes() == before


def test_a_published_hash_is_held_to(acme, site, tmp_path):
    file = replace(acme.SMALL, sha256="0" * 64)
    part = Component("acme", "", lambda *_: None, weights=(file,))
    store = WeightsStore(tmp_path / "weights", catalogue([entry(part)]))
    site.serve("/acme_v2.pth", saved(tmp_path / "x.pth").read_bytes())
    with pytest.raises(DownloadError, match="SHA-256"):
        store.fetch("acme-small")
    assert find(store.folder, "acme-small") is None


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ({"conv.weight": torch.zeros(4, 3, 3, 3)}, "1 of 3 tensors missing: conv.bias"),
        (weights(extra=torch.zeros(1)), "1 tensors unknown: extra"),
        (weights(**{"conv.bias": torch.zeros(5)}), r"conv.bias is \[5\], should be \[4\]"),
    ],
)
def test_what_does_not_fit_is_said(store, site, tmp_path, state, said):
    site.serve("/acme_v2.pth", saved(tmp_path / "x.pth", state).read_bytes())
    with pytest.raises(InputError, match=said) as error:
        store.fetch("acme-small")
    assert "is not 'acme-small'" in error.value.message and site.root in error.value.message
    assert [p.name for p in store.folder.iterdir()] == []


def test_a_web_page_a_cut_file_and_no_file(store, site, tmp_path):
    site.serve("/acme_v2.pth", b"<!DOCTYPE html><title>Login</title>")
    with pytest.raises(DownloadError, match="a web page instead of the file"):
        store.fetch("acme-small")
    site.serve("/acme_v2.pth", saved(tmp_path / "x.pth").read_bytes()[:-200])
    with pytest.raises(InputError, match="cut short"):
        store.fetch("acme-small")
    with pytest.raises(InputError, match="published at no address"):
        store.fetch("acme-big")
    assert list(store.folder.iterdir()) == []


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("form", ["zip", "old", "bare"])
def test_a_pickle_never_runs_code(store, site, tmp_path, form):
    mark = tmp_path / "was-here"
    path = tmp_path / "evil.pth"
    if form == "bare":
        path.write_bytes(pickle.dumps({"a": Evil(mark)}))
    else:
        torch.save({"a": Evil(mark)}, path, _use_new_zipfile_serialization=form == "zip")
    site.serve("/acme_v2.pth", path.read_bytes())
    with pytest.raises(InputError, match="more than tensors"):
        store.fetch("acme-small")
    with pytest.raises(InputError, match="more than tensors"):
        store.add(path)
    assert not mark.exists() and find(store.folder, "acme-small") is None
    pickle.loads(pickle.dumps(Evil(mark)))  # the trap does work
    assert mark.exists()


def test_numbers_beside_the_weights_do_no_harm(store, tmp_path):
    """A training run leaves its optimiser and figures of numpy in the same file."""
    state = {"model_state_dict": weights(), "loss": np.float64(0.25), "step": np.int64(800_000)}
    torch.save({**state, "optimizer": {"state": {0: {"exp_avg": torch.ones(4)}}}}, tmp_path / "x")
    assert store.add(tmp_path / "x")[0].name == "acme-small"


def test_a_file_is_recognised_by_its_tensors(store, tmp_path):
    file, path = store.add(saved(tmp_path / "downloaded (1).bin", wrap=""))
    assert file.name == "acme-small" and path == store.folder / "acme-small.safetensors"
    torch.testing.assert_close(read_state(path), weights())
    # a file from anywhere says nothing of the one that is published
    records = json.loads((store.folder / "weights.json").read_text())
    assert records["acme-small"]["published_sha256"] == ""
    file, _ = store.add(saved(tmp_path / "b.pth", {"big": torch.ones(2)}, wrap="state_dict"))
    assert file.name == "acme-big"


def test_what_nobody_knows_is_not_taken(store, tmp_path):
    path = saved(tmp_path / "x.pth", {"other": torch.ones(1)})
    with pytest.raises(InputError, match="nothing that a plugin knows") as error:
        store.add(path)
    assert "begin with other" in error.value.message and "acme-big: the one" in error.value.hint
    with pytest.raises(InputError, match="is not 'acme-big'"):
        store.add(path, "acme-big")
    with pytest.raises(UsageError, match="no such file"):
        store.add(tmp_path / "missing")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError):
        store.add(tmp_path / "notes.txt")
    assert not store.folder.exists()


def test_what_could_be_several_must_be_named(acme, tmp_path):
    twin = replace(acme.SMALL, name="acme-twin", file="twin.pth")
    part = Component("acme", "", lambda *_: None, weights=(acme.SMALL, twin))
    store = WeightsStore(tmp_path / "weights", catalogue([entry(part)]))
    path = saved(tmp_path / "x.pth")
    with pytest.raises(InputError, match="could be any of acme-small, acme-twin") as error:
        store.add(path)
    assert "--name acme-small" in error.value.hint
    assert store.add(path, "acme-twin")[0].name == "acme-twin"


def test_verify_of_a_good_file_in_a_folder_that_cannot_be_written(store, tmp_path, monkeypatch):
    store.add(saved(tmp_path / "x.pth"))
    (store.folder / "weights.json").unlink()

    def refuse(path):
        raise UsageError(f"cannot write {path}")

    monkeypatch.setattr("droidw.io.weights_store.atomic_write", refuse)
    assert "hash not recorded, since the folder cannot be written to, 3" in store.verify(
        "acme-small"
    )


def test_verify_and_every_later_load_notice_a_change(store, tmp_path):
    _, path = store.add(saved(tmp_path / "x.pth"))
    assert "hash as recorded, 3 tensors fit" in store.verify("acme-small")
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    times = path.stat()
    path.write_bytes(data)
    with pytest.raises(InputError, match="has changed since it was recorded"):
        load_state(store.folder, "acme-small")
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    with pytest.raises(InputError, match="has changed since it was recorded"):
        store.verify("acme-small")  # reads all of it, whatever the times say
    with pytest.raises(UsageError, match="are not in"):
        store.verify("acme-big")


def test_a_file_put_there_by_hand_is_found_and_recorded(store, acme, tmp_path):
    store.folder.mkdir()
    saved(store.folder / "acme_v2.pth")
    assert find(store.folder, "acme-small") is None  # the bare name does not know that one
    assert store.find(acme.SMALL) == find(store.folder, acme.SMALL)
    torch.testing.assert_close(load_state(store.folder, acme.SMALL), weights())
    assert "hash recorded now" in store.verify("acme-small")
    assert "hash as recorded" in store.verify("acme-small")


def test_what_is_missing_says_what_to_type(store):
    with pytest.raises(MissingRequirementError, match="'acme-small' are not in") as error:
        load_state(store.folder, "acme-small")
    assert "droidw weights fetch acme-small" in error.value.hint
    with pytest.raises(MissingRequirementError, match="none is set"):
        load_state(None, "acme-small")


def test_a_folder_that_cannot_be_written(store, tmp_path):
    store.folder.write_text("in the way")
    with pytest.raises(UsageError, match="cannot write"):
        store.add(saved(tmp_path / "x.pth"))


def test_a_full_disk_while_storing(store, tmp_path, monkeypatch):
    import safetensors.torch
    from safetensors import SafetensorError

    def full(*_, **__):
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(safetensors.torch, "save_file", full)
    with pytest.raises(UsageError, match="No space left"):
        store.add(saved(tmp_path / "x.pth"))
    assert list(store.folder.iterdir()) == []


def test_a_faulty_check_is_named(acme, tmp_path):
    path = saved(tmp_path / "x.pth")
    for check, said in (("no_such_module:f", "cannot be imported"), ("math:sqrt", "TypeError")):
        part = Component("a", "", lambda *_: None, weights=(replace(acme.SMALL, check=check),))
        store = WeightsStore(tmp_path / "weights", catalogue([entry(part)]))
        with pytest.raises(InputError, match=said):
            store.add(path, "acme-small")


def test_require_shapes_hands_back_what_the_network_takes():
    shapes = {"a": (2,), "b": (1, 3)}
    state = {"b": torch.zeros(1, 3), "a": torch.zeros(2)}
    assert list(require_shapes(state, shapes)) == ["a", "b"]
    del state["b"]
    assert list(require_shapes(state, shapes, optional=["b"])) == ["a"]
