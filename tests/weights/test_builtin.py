"""The published files of the built-in parts are told apart by their tensors."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import torch

from droidw.errors import InputError
from droidw.io.weights_store import WeightsStore, catalogue
from droidw.plugin.manager import load_plugins
from droidw.plugin.weights import WeightsFile
from droidw_plugins import _weights

FILES = [getattr(_weights, name) for name in _weights.__all__]


def checker(file):
    module, _, name = file.check.partition(":")
    return getattr(importlib.import_module(module), name)


def published(file):
    """Tensors without content, of the keys and shapes that the file is published with."""
    from droidw_plugins._vit.published import FORMS, transformer_shapes
    from droidw_plugins.correspondence._droid_state import expected_shapes
    from droidw_plugins.depth import _metric3d_net

    if file.name == "droid":  # saved from several cards, its two heads with a third channel
        heads = ("update.weight.2.", "update.delta.2.")
        shapes = {
            "module." + key: (3, *shape[1:]) if key.startswith(heads) else shape
            for key, shape in expected_shapes().items()
        }
    elif file.name in FORMS:
        shapes = transformer_shapes(*FORMS[file.name])
    else:
        shapes = _metric3d_net.published_shapes(file.name.removeprefix("metric3d-"))
    return {key: torch.empty(shape, device="meta") for key, shape in shapes.items()}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_each_is_recognised_by_its_own_check_alone(file):
    state = published(file)
    accepted = []
    for other in FILES:
        try:
            checker(other)(state)
        except InputError:
            continue
        accepted.append(other.name)
    assert accepted == [file.name]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_one_tensor_less_or_of_another_shape_is_refused(file):
    state = published(file)
    key = next(reversed(state))
    less = {name: value for name, value in state.items() if name != key}
    with pytest.raises(InputError, match="missing"):
        checker(file)(less)
    with pytest.raises(InputError, match="shape"):
        checker(file)(less | {key: torch.empty(7, 7, 7, device="meta")})
    with pytest.raises(InputError):
        checker(file)(state | {"stray": torch.empty(1, device="meta")})


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_records_say_what_a_user_must_know(file):
    assert isinstance(file, WeightsFile)
    assert file.urls and all(url.startswith("https://") for url in file.urls)
    assert file.licence and file.reference and file.file and file.size > 1e6


def test_every_name_that_a_built_in_asks_for_has_a_record():
    known = catalogue(load_plugins(environ={"DROIDW_LOAD_PLUGINS": ""}).entries())
    assert known and all(k.file in FILES for k in known.values())


def test_a_published_droid_file_is_added_and_loaded_back(tmp_path):
    """Of the published form: under "module.", three channels in the heads; 16 MB."""
    state = {key: torch.full(value.shape, 0.5) for key, value in published(_weights.DROID).items()}
    torch.save(state, tmp_path / "whatever.pth")
    from droidw.io.weights import load_state
    from droidw.io.weights_store import Known

    store = WeightsStore(tmp_path / "w", {file.name: Known(file) for file in FILES})
    file, _ = store.add(tmp_path / "whatever.pth")
    assert file.name == "droid"
    back = load_state(store.folder, "droid")
    assert len(back) == 102 and back["update.weight.2.weight"].shape[0] == 2
    assert sum(value.numel() for value in back.values()) == 4_002_565


def test_the_page_names_every_file():
    page = (Path(__file__).parents[2] / "docs" / "weights.md").read_text(encoding="utf-8")
    for file in FILES:
        assert f"| `{file.name}` |" in page and f"`{file.file}`" in page
