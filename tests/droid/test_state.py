"""Loading weights of exactly the published form, and refusing all others."""

from __future__ import annotations

import pytest
import torch

from droidw.errors import InputError, MissingRequirementError
from droidw.plugin.component import BuildContext
from droidw_plugins.correspondence._droid_net import DroidNet
from droidw_plugins.correspondence._droid_state import check_state, expected_shapes
from droidw_plugins.correspondence.droid import COMPONENT, DroidOptions


@pytest.fixture
def published(make_state):
    """As the authors' file: keys of a model on several cards, three channels in both heads."""
    state = {}
    for key, value in make_state().items():
        if key.startswith(("update.delta.2", "update.weight.2")):
            value = torch.cat([value, value[:1]])
        state["module." + key] = value
    return state


def test_the_published_form_is_taken(published, make_state):
    state = check_state(published)
    assert list(state) == list(expected_shapes())
    expected = make_state()
    assert all(torch.equal(state[key], expected[key]) for key in expected)
    assert sum(value.numel() for value in state.values()) == 4_002_565 and len(state) == 102


def test_built_from_a_file_on_disk(published, tmp_path, net):
    torch.save(published, tmp_path / "droid.pth")
    context = BuildContext(torch.device("cpu"), weights_dir=tmp_path)
    before = torch.random.get_rng_state()
    part = COMPONENT.factory(DroidOptions(), context)
    assert torch.equal(torch.random.get_rng_state(), before)
    own, other = part.net.state_dict(), net.state_dict()
    assert list(own) == list(other) and all(torch.equal(own[k], other[k]) for k in own)
    assert not any(p.requires_grad or p.is_meta for p in part.net.parameters())


def test_no_file_on_disk(tmp_path):
    context = BuildContext(torch.device("cpu"), weights_dir=tmp_path)
    with pytest.raises(MissingRequirementError, match="droidw weights fetch droid"):
        COMPONENT.factory(DroidOptions(), context)


def test_what_is_missing_is_named(published):
    del published["module.cnet.layer3.0.downsample.0.bias"]
    del published["module.update.gru.w.weight"]
    with pytest.raises(InputError) as caught:
        check_state(published)
    assert "2 of 102 tensors are missing" in caught.value.message
    assert "'cnet.layer3.0.downsample.0.bias', 'update.gru.w.weight'" in caught.value.message


def test_what_is_too_many_is_named(published):
    published["module.fnet.norm1.running_mean"] = torch.zeros(32)
    with pytest.raises(InputError, match=r"1 tensors do not belong.*fnet\.norm1\.running_mean"):
        check_state(published)


def test_another_shape_is_named(published):
    published["module.update.corr_encoder.0.weight"] = torch.zeros(128, 324, 1, 1)
    published["module.update.delta.2.bias"] = torch.zeros(1)
    with pytest.raises(InputError) as caught:
        check_state(published)
    said = str(caught.value)
    assert "'update.corr_encoder.0.weight' has shape [128, 324, 1, 1], not [128, 196, 1, 1]" in said
    assert "'update.delta.2.bias' has shape [1], not [2]" in said


def test_all_that_differs_is_said_at_once(published):
    del published["module.fnet.conv1.bias"]
    published["other"] = torch.zeros(1)
    with pytest.raises(InputError) as caught:
        check_state(published)
    assert "fnet.conv1.bias" in str(caught.value) and "'other'" in str(caught.value)


def test_a_key_with_and_without_prefix(published):
    published["fnet.conv1.bias"] = torch.zeros(32)
    with pytest.raises(InputError, match="twice"):
        check_state(published)


def test_a_network_of_another_kind():
    with pytest.raises(InputError, match="102 of 102 tensors are missing"):
        DroidNet.from_state({"cls_token": torch.zeros(1, 1, 384)})
