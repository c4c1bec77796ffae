import pytest
import torch
from droidw_plugin_template import COMPONENT, GradientOptions
from droidw_plugin_template.gradients import GradientFeatures

import droidw
from droidw.geometry.camera import Grid
from droidw.testing.conformance import check_feature_extractor


def test_it_keeps_the_contract_of_its_kind():
    check_feature_extractor(COMPONENT)


def test_droidw_finds_it():
    entry = droidw.load_plugins(environ={}).registry("features").entry("gradients")
    assert entry.component is COMPONENT
    assert entry.origin == "droidw-plugin-template 0.1.0"


def test_a_ramp_has_its_slope_and_no_gradient_across():
    ramp = torch.linspace(0, 1, 65).expand(3, 49, 65)
    features = GradientFeatures(levels=1, gain=64.0).extract(ramp, Grid.of(49, 65, 8, 4.0))
    brightness, across, down, length = features[:, 1:-1, 1:-1]
    assert brightness[0].tolist() == pytest.approx([(4 + 8 * k) / 64 for k in range(1, 7)])
    assert across.flatten().tolist() == pytest.approx([1.0] * across.numel(), abs=1e-4)
    assert down.abs().max() < 1e-4
    assert torch.allclose(length, across, atol=1e-4)


def test_levels_set_the_number_of_channels():
    options = GradientOptions(levels=2)
    extractor = COMPONENT.factory(options, droidw.BuildContext(torch.device("cpu")))
    assert extractor.dim == 8
    assert extractor.extract(torch.rand(3, 40, 56), Grid.of(40, 56, 8, 3.5)).shape == (8, 5, 7)
