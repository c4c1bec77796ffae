"""The update operator, encoders and upsampling against the published formulas, written plainly."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from droidw_plugins.correspondence._droid_net import (
    DroidNet,
    motion_features,
    upsample_convex,
)


@pytest.fixture(scope="module")
def other(make_state):
    """(network, its state) with weights of another rule."""
    state = make_state("another rule/")
    return DroidNet.from_state(state), state


def conv(state, name, x, **options):
    weight = state[name + ".weight"]
    padding = options.pop("padding", weight.shape[-1] // 2)
    return F.conv2d(x, weight, state[name + ".bias"], padding=padding, **options)


def plain_update(state, net, inp, corr, motion):
    """REFERENCE 1.4 line by line, every edge with a context of its own."""
    s = {key.removeprefix("update."): value for key, value in state.items()}
    c = F.relu(conv(s, "corr_encoder.2", F.relu(conv(s, "corr_encoder.0", corr))))
    f = F.relu(conv(s, "flow_encoder.2", F.relu(conv(s, "flow_encoder.0", motion))))
    x = torch.cat([inp, c, f], 1)
    g = (torch.sigmoid(conv(s, "gru.w", net)) * net).mean(dim=(2, 3), keepdim=True)
    both = torch.cat([net, x], 1)
    z = torch.sigmoid(conv(s, "gru.convz", both) + conv(s, "gru.convz_glo", g))
    r = torch.sigmoid(conv(s, "gru.convr", both) + conv(s, "gru.convr_glo", g))
    reset = torch.cat([r * net, x], 1)
    q = torch.tanh(conv(s, "gru.convq", reset) + conv(s, "gru.convq_glo", g))
    net = (1 - z) * net + z * q
    delta = conv(s, "delta.2", F.relu(conv(s, "delta.0", net)))
    weight = torch.sigmoid(conv(s, "weight.2", F.relu(conv(s, "weight.0", net))))
    return net, delta.permute(0, 2, 3, 1), weight.permute(0, 2, 3, 1)


def plain_encoder(state, name, x, normed):
    """REFERENCE 1.2, with torch's own instance normalisation."""

    def norm(y):
        return F.instance_norm(y) if normed else y

    x = F.relu(norm(conv(state, f"{name}.conv1", x, stride=2)))
    for layer, stride in (("layer1", 1), ("layer2", 2), ("layer3", 2)):
        for block, step in ((0, stride), (1, 1)):
            key = f"{name}.{layer}.{block}"
            y = F.relu(norm(conv(state, f"{key}.conv1", x, stride=step)))
            y = F.relu(norm(conv(state, f"{key}.conv2", y)))
            if step == 2:
                x = norm(conv(state, f"{key}.downsample.0", x, stride=2, padding=0))
            x = F.relu(x + y)
    return conv(state, f"{name}.conv2", x)


def inputs(count, h, w, seed=0):
    g = torch.Generator().manual_seed(seed)
    net = torch.tanh(torch.randn(count, 128, h, w, generator=g))
    inp = torch.relu(torch.randn(count, 128, h, w, generator=g))
    corr = torch.randn(count, 196, h, w, generator=g)
    motion = 8 * torch.randn(count, 4, h, w, generator=g)
    return net, inp, corr, motion


@pytest.mark.parametrize(("h", "w"), [(8, 12), (15, 9)])
def test_one_round(other, h, w):
    network, state = other
    net, inp, corr, motion = inputs(4, h, w)
    inp = inp[[0, 1, 1, 0]]
    which = torch.tensor([0, 1, 1, 0])
    with torch.no_grad():
        found = network.update(net, inp[:2], corr, motion, which, aggregate=False)
        expected = plain_update(state, net, inp, corr, motion)
    for a, b in zip((found.net, found.delta, found.weight), expected, strict=True):
        assert float((a - b).norm() / b.norm()) < 1e-5
    assert found.gathered is None


def test_a_round_without_motion_in_two_parts(other):
    network, state = other
    net, inp, corr, _ = inputs(1, 8, 10)
    with torch.no_grad():
        still = network.update.still(net, inp)
        found = network.update.drift(still, corr)
        _, expected, _ = plain_update(state, net, inp, corr, torch.zeros(1, 4, 8, 10))
        default = network.update(net, inp, corr).delta
    assert float((found - expected[0]).norm() / expected.norm()) < 1e-5
    assert torch.allclose(default, expected, atol=1e-5)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (72, 104), (88, 80)])
def test_encoders_at_other_sizes(other, height, width):
    network, state = other
    images = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(1))
    mean = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
    std = torch.tensor([0.229, 0.224, 0.225])[:, None, None]
    with torch.no_grad():
        found = network.features(images)
        expected = plain_encoder(state, "fnet", (images - mean) / std, normed=True)
        hidden, context = network.context(images)
        both = plain_encoder(state, "cnet", (images - mean) / std, normed=False)
    assert found.shape == (2, 128, height // 8, width // 8)
    assert float((found - expected).norm() / expected.norm()) < 2e-5
    assert torch.allclose(hidden, torch.tanh(both[:, :128]), atol=1e-4)
    assert torch.allclose(context, torch.relu(both[:, 128:]), atol=1e-4)


def test_motion_features_are_clamped_and_in_order():
    grid = torch.zeros(1, 1, 2)
    coords = torch.tensor([[[[3.0, -100.0]]]])
    target = torch.tensor([[[[90.0, -99.0]]]])
    found = motion_features(coords, target, grid)
    assert found.flatten().tolist() == [3.0, -64.0, 64.0, 1.0]


def test_upsampling_picks_the_neighbour_that_the_mask_says():
    disp = torch.arange(1.0, 13.0).view(1, 3, 4)
    for k in range(9):
        mask = torch.full((1, 576, 3, 4), -50.0)
        mask.view(1, 9, 64, 3, 4)[:, k] = 50.0
        fine = upsample_convex(disp, mask)[0]
        y, x = min(max(1 + k // 3 - 1, 0), 2), min(max(2 + k % 3 - 1, 0), 3)
        assert fine.shape == (24, 32)
        assert torch.allclose(fine[8:16, 16:24], disp[0, y, x].expand(8, 8), atol=1e-5)


def test_fine_pixels_of_a_cell_are_row_by_row():
    mask = torch.zeros(1, 9, 8, 8, 2, 2)
    mask[:, 5, 2, 6] = 50.0  # the right neighbour, for sub-row 2 and sub-column 6
    disp = torch.tensor([[[0.0, 1.0], [0.0, 1.0]]])
    fine = upsample_convex(disp, mask.view(1, 576, 2, 2))[0]
    assert float(fine[2, 6]) == pytest.approx(1.0)
    assert float(fine[6, 2]) == pytest.approx(3 / 9)


def test_a_flat_map_stays_flat_up_to_its_border_unless_as_published():
    mask = torch.zeros(1, 576, 4, 5)
    flat = torch.full((1, 4, 5), 0.5)
    assert torch.allclose(upsample_convex(flat, mask), torch.tensor(0.5))
    published = upsample_convex(flat, mask, "zeros")[0]
    assert float(published[0, 0]) == pytest.approx(0.5 * 4 / 9)
    assert torch.allclose(published[8:-8, 8:-8], torch.tensor(0.5))
