"""Depth `metric3d`: parity with the published network and call, metres, refusals."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from droidw.errors import ConfigError, InputError, MissingRequirementError
from droidw.geometry.camera import Camera
from droidw.io.weights_store import Known, WeightsStore
from droidw.plugin.component import BuildContext
from droidw.slam.frame import Frame
from droidw.testing.conformance import check_depth_prior
from droidw_plugins._weights import FIT3D, METRIC3D_VIT_LARGE, METRIC3D_VIT_SMALL
from droidw_plugins.depth import _metric3d_net as net
from droidw_plugins.depth._metric3d import Metric3dDepth, fit_into
from droidw_plugins.depth.metric3d import COMPONENT, Metric3dOptions

CPU = torch.device("cpu")
RECORDS = (METRIC3D_VIT_SMALL, METRIC3D_VIT_LARGE, FIT3D)
LIMITS = {"depth": 2e-3, "confidence": 4e-4, "prediction_normal": 3e-4}
"""As suggested in ../shared/parity/networks/README.md."""


@pytest.fixture(scope="module")
def small(stand_in):
    state = {"model_state_dict": stand_in("metric3d-vit-small")}
    return net.load_metric3d("vit-small", state, CPU, torch.float32)


@pytest.fixture
def prior(checkpoint):
    """Build the small prior: `prior(size=[56, 84], compat=True, fx=200.0)`."""

    def build(compat=False, fx=None, **options):
        options = {"variant": "vit-small", "size": [56, 84], **options}
        options.setdefault("weights", str(checkpoint("metric3d-vit-small")))
        context = BuildContext(
            CPU,
            compat=frozenset({"droid-w"} if compat else ()),
            camera=None if fx is None else Camera(640, 480, fx, fx, 319.5, 239.5),
        )
        found = COMPONENT.factory(Metric3dOptions(**options), context)
        assert isinstance(found, Metric3dDepth)
        return found

    return build


def frame(height=60, width=80, fx=70.0, seed=1):
    image = torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))
    return Frame(0, 0.0, image, torch.tensor([fx, fx, width / 2, height / 2]))


def gap(found, expected):
    assert found.shape == expected.shape
    return float((found - expected.float()).abs().max())


@pytest.mark.parametrize("variant", ["vit-small", "vit-large"])
def test_keys_are_those_of_the_published_file(variant, key_list):
    expected = key_list(f"metric3d/keys_metric3d_{variant.replace('-', '_')}.json")
    assert net.published_shapes(variant) == expected


@torch.no_grad()
def check_parity(network, expected, x):
    """Hold what comes out, and every step on the way, against the published network."""
    tokens, height, width = network.encode(x)
    assert gap(tokens, expected["encoder_tokens"]) < 3e-5
    decoder = network.decoder
    maps = decoder.token2feature(tokens, height, width)
    inputs = decoder.context_inputs(maps)
    for name, found in zip(("quarter", "seventh", "fourteenth"), inputs, strict=True):
        assert gap(found, expected[f"context_in_{name}"]) < 3e-4
    fused = decoder.decoder_mono(maps)
    assert gap(fused, expected["decoder_feature"]) < 1e-3
    state = decoder.first(fused)
    hidden, context = decoder.start(maps)
    hidden, change = decoder.update_block(hidden, context, state)
    assert gap(change, expected["delta_iter0"]) < 3e-4
    mask = decoder.weigh(hidden)
    assert gap(mask, expected["mask_iter0"]) < 1e-2  # stored in half precision
    first = net._read(net._enlarge_convex(state + change, mask))
    assert gap(first.depth, expected["depth_iter0"]) < LIMITS["depth"]
    found = network(x)
    for name, limit in LIMITS.items():
        value = found.normal if name == "prediction_normal" else getattr(found, name)
        assert gap(value, expected[name]) < limit


def test_small_network_gives_what_the_published_one_gives(small, parity, normalised):
    expected = parity("metric3d/metric3d_vit_small.npz")
    check_parity(small, expected, normalised(expected["image"]))


@pytest.mark.slow
def test_large_network_gives_what_the_published_one_gives(stand_in, parity, normalised):
    """Makes 412 million weights up, 1.7 GB."""
    expected = parity("metric3d/metric3d_vit_large.npz")
    network = net.load_metric3d("vit-large", stand_in("metric3d-vit-large"), CPU, torch.float32)
    check_parity(network, expected, normalised(expected["image"]))


def test_the_whole_call_of_the_published_system(prior, parity):
    """Resize, pad, network at 616x1064, crop, resize, its scale, clamp."""
    expected = parity("metric3d/metric3d_vit_small_droidw_call.npz")
    part = prior(compat=True, fx=float(expected["fx"]), size=[616, 1064])
    image = expected["image"].permute(2, 0, 1).float() / 255
    shown = part.network_input(image)
    assert shown.shape == (1, 3, 616, 1064)
    assert gap(shown[:, :, ::4, ::4], expected["network_input_every4"]) < 1e-5
    canonical = part.canonical_depth(shown)
    assert gap(canonical[:, :, ::8, ::8], expected["canonical_depth_every8"]) < 3e-3
    part.canonical_depth = lambda x: canonical  # the network takes ten seconds: once will do
    found = part.predict(Frame(0, 0.0, image, torch.tensor([9.0, 9.0, 80.0, 60.0])))
    assert gap(found.depth, expected["depth"]) < 5e-4
    assert part.metric is False


@pytest.mark.parametrize(
    ("size", "out"),
    [((28, 28), (28, 28)), ((98, 126), (96, 124)), ((100, 130), (112, 140)), ((56, 70), (56, 68))],
)
@torch.no_grad()
def test_sizes_that_come_out(small, size, out):
    found = small(torch.zeros(1, 3, *size))
    assert found.depth.shape == (1, 1, *out) and found.normal.shape == (1, 4, *out)
    assert torch.allclose(found.normal[:, :3].norm(dim=1), torch.ones(1, *out), atol=1e-4)
    assert found.normal[:, 3].min() > 0.01 and found.depth.min() >= 0.1
    assert not found.depth.requires_grad


def test_depth_is_metric_with_the_focal_length_of_the_working_picture(prior):
    ours = prior()
    assert ours.metric is True
    found = ours.predict(frame(fx=70.0)).depth
    assert found.shape == (60, 80) and found.dtype == torch.float32
    # In proportion to the focal length: what looks as large through a longer lens is farther.
    assert torch.allclose(ours.predict(frame(fx=140.0)).depth, 2 * found, rtol=1e-5)
    # By the published rule, a raw camera of 640x480 reduced to 80x60 makes it wrong by a factor
    # of (raw focal length) / (focal length at the size that the network sees).
    theirs = prior(compat=True, fx=560.0).predict(frame(fx=70.0)).depth
    seen = 70.0 * fit_into(60, 80, (56, 84)).scale
    assert torch.allclose(theirs, found * (560.0 / seen), rtol=1e-5)


def test_depth_does_not_depend_on_the_working_size(prior):
    part, found = prior(), []
    coarse = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(8))
    for height, width in ((60, 80), (120, 160)):
        image = F.interpolate(coarse, size=(height, width), mode="bilinear")[0]
        taken = Frame(0, 0.0, image, torch.tensor([0.9, 0.9, 0.5, 0.5]) * width)
        found.append(float(part.predict(taken).depth.mean()))
    assert abs(found[0] / found[1] - 1) < 0.01


def test_pictures_are_fitted_and_padded_evenly(prior):
    assert fit_into(120, 160, (616, 1064)) == (616 / 120, 616, 821, 0, 121)
    assert fit_into(384, 512, (616, 1064))[1:] == (616, 821, 0, 121)
    assert fit_into(100, 400, (616, 1064))[1:] == (266, 1064, 175, 0)
    shown = prior().network_input(torch.ones(3, 60, 80))
    assert shown.shape == (1, 3, 56, 84)
    assert (shown[..., :4] == 0).all() and (shown[..., -5:] == 0).all()
    assert (shown[..., 5:78] > 2).all()
    wide = prior().predict(frame(33, 131)).depth
    assert wide.shape == (33, 131) and torch.isfinite(wide).all() and wide.min() >= 0


def test_bfloat16(prior):
    exact = prior().predict(frame()).depth
    rough = prior(precision="bfloat16").predict(frame()).depth
    assert rough.dtype == torch.float32 and torch.isfinite(rough).all()
    assert 0 < float(((rough - exact).abs() / exact).median()) < 0.05


def test_contract(checkpoint, device):
    options = Metric3dOptions(
        variant="vit-small", size=[56, 84], weights=str(checkpoint("metric3d-vit-small"))
    )
    check_depth_prior(COMPONENT, device, options)


def test_only_the_unused_mask_token_may_be_absent(stand_in):
    state = dict(stand_in("metric3d-vit-small"))
    del state["depth_model.encoder.mask_token"]
    checked = net.check_vit_small({"model_state_dict": state, "optimizer": {}})
    assert len(checked) == 361 and net.check_vit_small(checked).keys() == checked.keys()
    pointers = {value.data_ptr() for value in checked.values()}
    assert len(pointers) == len(checked)  # the two names of one layer share nothing any more
    for key in ("depth_model.encoder.norm.bias", "depth_model.decoder.update_block.mask.2.bias"):
        less = {k: v for k, v in state.items() if k != key}
        with pytest.raises(InputError, match=f"of 362 tensors 1 is missing .'{key}'"):
            net.check_vit_small(less)


@torch.no_grad()
def test_of_two_names_of_one_layer_the_later_counts(stand_in, small):
    state = dict(stand_in("metric3d-vit-small"))
    for key in state:
        if ".norm3." in key:
            state[key] = torch.zeros_like(state[key])
    x = torch.rand(1, 3, 28, 56, generator=torch.Generator().manual_seed(7))
    found = net.load_metric3d("vit-small", state, CPU, torch.float32)(x)
    assert torch.equal(found.depth, small(x).depth)


def test_refusals(prior, checkpoint, tmp_path):
    for size in ([616], [616, 1060], [14, 28], [0, 0]):
        with pytest.raises(ConfigError, match=r"depth\.options\.size: .* is not a size"):
            prior(size=size)
    with pytest.raises(ConfigError, match=r"depth\.options\.precision: float16 needs a GPU"):
        prior(precision="float16")
    with pytest.raises(ConfigError, match="focal length of the raw pictures"):
        prior(compat=True)
    with pytest.raises(InputError, match="5000x1 pixels is too narrow"):
        prior().predict(frame(1, 5000))
    whole = checkpoint("metric3d-vit-small").read_bytes()
    (tmp_path / "cut.pth").write_bytes(whole[: len(whole) // 3])
    with pytest.raises(InputError, match="cut short"):
        prior(weights=str(tmp_path / "cut.pth"))
    with pytest.raises(InputError) as caught:
        prior(variant="vit-large")
    assert "metric3d-vit-small.pth: these are not the weights 'metric3d-vit-large'" in str(
        caught.value
    )
    assert "are missing ('depth_model.encoder.blocks.0.12.norm1.weight'" in str(caught.value)
    assert "it looks like Metric3D v2" in str(caught.value)
    with pytest.raises(InputError, match=r"looks like FiT3D or timm with registers \('fit3d'\)"):
        prior(weights=str(checkpoint("fit3d")))


def test_weights_follow_the_options(tmp_path):
    assert COMPONENT.weights_for() == (METRIC3D_VIT_LARGE,)
    assert COMPONENT.weights_for(Metric3dOptions(variant="vit-small")) == (METRIC3D_VIT_SMALL,)
    assert COMPONENT.weights_for(Metric3dOptions(weights="x.pth")) == ()
    with pytest.raises(MissingRequirementError, match="'metric3d-vit-large' are not in"):
        COMPONENT.factory(Metric3dOptions(), BuildContext(CPU, weights_dir=tmp_path))


def test_a_published_file_is_added_and_used(stand_in, prior, tmp_path):
    """As it is published: more than weights in it, and one layer under two names."""
    state = dict(stand_in("metric3d-vit-small"))
    for key in state:
        if ".norm3." in key:
            state[key] = state[key.replace(".norm3.", ".downsample.1.")]
    torch.save({"model_state_dict": state, "optimizer": {"step": 7}}, tmp_path / "downloaded.pth")
    store = WeightsStore(tmp_path / "weights", {r.name: Known(r) for r in RECORDS})
    record, _ = store.add(tmp_path / "downloaded.pth")
    assert record == METRIC3D_VIT_SMALL
    context = BuildContext(CPU, weights_dir=tmp_path / "weights")
    options = Metric3dOptions(variant="vit-small", size=[56, 84])
    found = COMPONENT.factory(options, context).predict(frame()).depth
    # The files align tensors in memory differently, and sums may then be taken in another order.
    assert torch.allclose(found, prior().predict(frame()).depth, rtol=1e-4)
