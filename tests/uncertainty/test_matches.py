"""The scale of similarities that is found from measured matches."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from droidw.geometry.projective import pixel_grid
from droidw.plugin.component import BuildContext
from droidw_plugins.uncertainty import affine_softplus, mlp, per_pixel
from droidw_plugins.uncertainty._matches import (
    MEDIAN,
    QUARTILE,
    MatchScale,
    matches,
    weighted_quantiles,
)

CPU = BuildContext(torch.device("cpu"))
MODELS = pytest.mark.parametrize("module", [affine_softplus, mlp, per_pixel])


def drawn(count=4001, scale=0.02, power=1.0, seed=0):
    """Cosines whose dissimilarity is a power of a log-normal number."""
    draw = torch.Generator().manual_seed(seed)
    return 1 - scale * torch.randn(count, generator=draw).exp() ** power


def test_quantiles_are_those_of_repeated_values():
    draw = np.random.default_rng(0)
    values, counts = draw.normal(size=301), draw.integers(0, 4, 301)
    found = weighted_quantiles(torch.tensor(values), torch.tensor(counts), (0.25, 0.5, 0.75))
    repeated = np.repeat(values, counts)
    wanted = np.quantile(repeated, (0.25, 0.5, 0.75), method="inverted_cdf")
    assert found.tolist() == wanted.tolist()


@pytest.mark.parametrize("scale", [0.0005, 0.02, 0.4])
@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_quartile_and_median_are_brought_to_their_place(scale, power):
    cosine = drawn(scale=scale, power=power)
    found = MatchScale()
    found.look(cosine, torch.ones_like(cosine))
    apart = 1 - found(cosine)
    assert float(apart.quantile(0.5)) == pytest.approx(MEDIAN, rel=1e-3)
    assert float(apart.quantile(0.75)) == pytest.approx(QUARTILE, rel=1e-3)
    order = cosine.argsort()
    assert bool((found(cosine)[order].diff() >= 0).all())
    assert found(torch.ones(1)).item() == 1.0


def test_what_was_not_matched_has_no_say():
    cosine, weight = drawn(), torch.ones(4001)
    alone, mixed = MatchScale(), MatchScale()
    alone.look(cosine, weight)
    rubbish = torch.cat([torch.full((5000,), -0.3), torch.full((9,), torch.nan)])
    mixed.look(torch.cat([cosine, rubbish]), torch.cat([weight, torch.zeros(5009)]))
    assert (mixed.quartile, mixed.median) == (alone.quartile, alone.median)


@pytest.mark.parametrize(
    ("cosine", "weight"),
    [
        (torch.full((500,), 0.5), torch.zeros(500)),
        (torch.full((500,), 0.5), torch.full((500,), torch.nan)),
        (torch.full((50,), 0.5), torch.ones(50)),
        (torch.ones(500), torch.ones(500)),
        (torch.zeros(0), torch.zeros(0)),
    ],
    ids=["no match", "no number", "too few", "all alike", "no edge"],
)
def test_what_tells_nothing_changes_nothing(cosine, weight):
    scale = MatchScale()
    scale.look(cosine, weight)
    assert scale.looks == 0 and scale.state_dict() == {}
    assert torch.equal(scale(drawn()), drawn())


def test_looks_are_averaged_and_kept():
    scale, twin = MatchScale(), MatchScale()
    for seed, size in enumerate((0.01, 0.04)):
        scale.look(drawn(scale=size, seed=seed), torch.ones(4001))
    assert scale.median == pytest.approx(0.02, rel=0.05)
    twin.load_state_dict(scale.state_dict())
    assert torch.equal(twin(drawn()), scale(drawn()))
    twin.load_state_dict({})
    assert twin.looks == 0


def noisy(view, seed=0):
    """The still view of these tests with noise on all features, and the matches that it has."""
    n, _, h, w = view.features.shape
    draw = torch.Generator().manual_seed(seed)
    noise = torch.randn(view.features.shape, generator=draw)
    size = 0.1 + 0.3 * torch.rand(n, 1, h, w, generator=draw)
    target = pixel_grid(h, w, torch.float32, view.disps.device).expand(len(view.ii), h, w, 2)
    return dataclasses.replace(
        view, features=view.features + size * noise, target=target.contiguous(), calibrate=True
    )


def unlike(view):
    """The same features made of one length, with a large common part: all cosines near one."""
    features = torch.nn.functional.normalize(view.features, dim=1)
    common = torch.full_like(features[:, :1], 4.0)
    return features, torch.cat([features, common], dim=1)


@MODELS
def test_features_with_a_common_part_give_the_same_maps(module, view_of):
    """Raw, their cosines are all above 0.9, and nothing looks as if it moved."""
    found = {}
    base = noisy(view_of(module.COMPONENT.factory(module.COMPONENT.options(), CPU)))
    for calibrate in (True, False):
        for number, features in enumerate(unlike(base)):
            model = per_pixel_like(module)
            fresh = view_of(model, features.shape[1])
            view = dataclasses.replace(
                fresh, features=features, target=base.target, calibrate=calibrate
            )
            for index in range(len(features)):
                model.append(view, index)
            reports = [model.update(view) for _ in range(3)]
            found[calibrate, number] = reports[0].energy, view.uncertainty.clone()
    assert found[True, 0][0] == pytest.approx(found[True, 1][0], rel=1e-3)
    assert found[False, 0][0] > 5 * found[False, 1][0]
    if module is per_pixel:  # the others see the features too
        assert torch.allclose(found[True, 0][1], found[True, 1][1], atol=1e-4)


def per_pixel_like(module):
    """A model that starts with the same u everywhere, whatever the number of channels."""
    options = {} if module is per_pixel else {"init_scale": 0.0}
    return module.COMPONENT.factory(module.COMPONENT.options(**options), CPU)


@MODELS
def test_without_being_asked_the_cosine_is_raw(module, view_of):
    maps = []
    for calibrate in (False, True):
        model = per_pixel_like(module)
        view = dataclasses.replace(noisy(view_of(model)), calibrate=calibrate)
        for index in range(len(view.features)):
            model.append(view, index)
        model.update(view)
        assert ("matches" in model.state_dict()) is calibrate
        maps.append(view.uncertainty)
    assert not torch.equal(*maps)


@MODELS
def test_a_model_goes_on_with_its_scale(module, view_of):
    first, second = per_pixel_like(module), per_pixel_like(module)
    view = noisy(view_of(first))
    for index in range(len(view.features)):
        first.append(view, index)
    first.update(view)
    fields = {name: value.clone() for name, value in view.fields.items()}
    copy = dataclasses.replace(view, uncertainty=view.uncertainty.clone(), fields=fields)
    second.load_state_dict(first.state_dict())
    # Without a match in sight, only what was kept can tell the scale.
    blind = {"confidence": torch.zeros_like(view.confidence)}
    first.update(dataclasses.replace(view, **blind))
    second.update(dataclasses.replace(copy, **blind))
    assert torch.equal(view.uncertainty, copy.uncertainty)


def test_matches_of_some_edges(view_of):
    model = per_pixel_like(per_pixel)
    view = noisy(view_of(model))
    view.target[:, 0, 0] = torch.tensor([-3.0, 0.0])
    used = torch.zeros(len(view.ii), dtype=torch.bool)
    assert matches(view, used, 0) is None
    used[4:] = True
    samples, weight = matches(view, used, 0)
    assert len(samples.source) == len(weight) <= 16
    assert bool((weight[:, 0] == 0).all()) and bool((weight[:, 1:] == 1).all())
