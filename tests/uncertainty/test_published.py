"""What lies between the learned map and the written one: smoothing, residuals, calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from droidw.geometry.projective import reproject
from droidw.interfaces.uncertainty import UncertaintyModel, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty import affine_softplus, mlp, per_pixel
from droidw_plugins.uncertainty._published import agreeing_majority, box_mean, residual_factor

Start = Callable[..., UncertaintyView]
MODELS = (affine_softplus, per_pixel, mlp)
EACH = pytest.mark.parametrize("module", MODELS, ids=lambda m: m.COMPONENT.name)


def _model(module: Any, **options: object) -> UncertaintyModel:
    component = module.COMPONENT
    model = component.factory(component.options(**options), BuildContext(torch.device("cpu")))
    assert isinstance(model, UncertaintyModel)
    return model


def test_means_over_cells() -> None:
    maps = torch.rand(2, 4, 5, generator=torch.Generator().manual_seed(0))
    assert box_mean(maps, 0) is maps
    found = box_mean(maps, 1)
    assert torch.allclose(found[:, 2, 2], maps[:, 1:4, 1:4].mean((1, 2)))
    assert torch.allclose(found[:, 0, 0], maps[:, :2, :2].mean((1, 2)))
    assert torch.allclose(box_mean(torch.ones(1, 4, 5), 2), torch.ones(1, 4, 5))


def test_factor_is_below_one_where_motion_agrees() -> None:
    residual = torch.tensor([[[0.0, 0.2, 3.0, 0.0, torch.nan]]]).repeat(2, 1, 1)
    confidence = torch.tensor([[[1.0, 1.0, 1.0, 0.0, 1.0]]]).repeat(2, 1, 1)
    ii = torch.tensor([1, 1])
    found = residual_factor(residual, confidence, ii, 3, scale=0.2, gain=0.3, smooth=0)
    assert torch.allclose(found[0], torch.ones(1, 5), atol=1e-6)  # no edge starts there
    agree, half, apart, unmeasured, broken = found[1, 0].tolist()
    assert 0.8 <= agree < 0.81
    assert half == pytest.approx(1 + 0.3 * (1 / 3 - 0.5), abs=0.01)
    assert 1.09 < apart <= 1.1
    assert unmeasured == pytest.approx(1.0, abs=1e-6)
    assert broken == pytest.approx(1.0, abs=1e-6)


def test_a_few_bad_matches_do_not_outweigh_those_that_agree() -> None:
    residual = torch.zeros(4, 1, 3)
    residual[0, 0, 0] = 50.0  # one of four
    residual[1:, 0, 1] = 50.0  # three of four
    ones, ii = torch.ones(4, 1, 3), torch.zeros(4, dtype=torch.int64)
    found = residual_factor(residual, ones, ii, 1, 0.2, 0.9, smooth=1, each=True)[0, 0]
    assert found.tolist() == pytest.approx([0.64, 1.07, 0.42], abs=0.02)
    mean = residual_factor(residual, ones, ii, 1, 0.2, 0.9, smooth=0)[0, 0]
    assert mean.tolist() == pytest.approx([1.27, 1.3, 0.4], abs=0.04)
    none = residual_factor(residual, 0.0 * ones, ii, 1, 0.2, 0.9, smooth=1, each=True)
    assert torch.allclose(none, torch.ones(1, 1, 3))


def test_residuals_count_where_most_of_the_measured_motion_agrees() -> None:
    def believed(agreeing: int, least: float = 0.6) -> float:
        residual = torch.full((1, 1, 10), 50.0)
        residual[..., :agreeing] = 0.0
        return float(agreeing_majority(residual, torch.ones(1, 1, 10), 0.2, least))

    assert [round(believed(n), 1) for n in (0, 6, 7, 8, 10)] == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert believed(0, least=0.0) == 1.0
    broken = torch.tensor([[[0.0, torch.nan, 9.0]]])
    assert agreeing_majority(broken, torch.tensor([[[1.0, 1.0, 0.0]]]), 0.2, 0.5) == 1.0
    assert agreeing_majority(broken, torch.zeros(1, 1, 3), 0.2, 0.5) == 0.0  # nothing measured


def _measured(view: UncertaintyView) -> UncertaintyView:
    """The camera stands still and is measured to; the three right columns move by two cells."""
    coords, _ = reproject(view.T_cw, view.disps, view.intrinsics, view.ii, view.jj)
    target = coords.clone()
    target[:, :, 4:, 0] += 2.0
    return replace(view, target=target)


@EACH
def test_residuals_change_what_is_written_and_not_what_is_learned(
    module: Any, started: Start
) -> None:
    def maps(**options: object) -> Tensor:
        model = _model(module, **options)
        view = _measured(started(model))
        for _ in range(5):
            model.update(view)
        return view.uncertainty

    plain, weighed = maps(), maps(residual_gain=0.3)
    ratio = weighed / plain
    assert torch.allclose(ratio[:, :, :4], torch.tensor(0.8), atol=0.01)
    assert torch.allclose(ratio[:, :, 4:], torch.tensor(1.1), atol=0.01)
    smooth = maps(smooth=1)
    assert torch.allclose(smooth, box_mean(plain, 1), atol=1e-6)


@EACH
def test_once_the_path_is_mended_what_moves_need_not_agree(module: Any, started: Start) -> None:
    """Three columns of seven disagree: too many to believe the rest, but for one that is closed."""

    def maps(mended: bool, closed: int, **options: object) -> Tensor:
        model = _model(module, residual_majority=0.7, **options)
        view = replace(_measured(started(model)), mended=mended)
        gate = torch.ones(view.disps.shape)
        gate[:, :, 7 - closed :] = 0.0
        model.update(replace(view, gate=lambda _: gate))
        return view.uncertainty

    plain = maps(True, 0)
    for mended in (False, True):
        assert torch.allclose(maps(mended, 3, residual_gain=0.3), plain, atol=1e-6)
    assert torch.allclose(maps(False, 3, mended_gain=0.6), plain, atol=1e-6)
    ratio = maps(True, 3, mended_gain=0.6) / plain
    assert torch.allclose(ratio[:, :, :4], torch.tensor(0.6), atol=0.02)
    assert torch.allclose(ratio[:, :, 4:], torch.tensor(1.2), atol=0.02)
    some = maps(True, 0, mended_gain=0.6) / plain  # 0.57 agree: a third of the way from 0.5 to 0.7
    assert torch.allclose(some[:, :, :4], torch.tensor(1 - 0.4 * 0.36), atol=0.02)


@EACH
def test_the_off_diagonal_of_confidence_says_nothing_of_how_sure_it_is(
    module: Any, started: Start
) -> None:
    maps = []
    for off in (None, 0.0, -0.7):
        model = _model(module, residual_gain=0.3)
        view = replace(_measured(started(model)), calibrate=True)
        if off is not None:
            confidence = torch.nn.functional.pad(view.confidence, (0, 1), value=off)
            view = replace(view, confidence=confidence)
        for _ in range(2):
            model.update(view)
        maps.append(view.uncertainty)
    assert torch.equal(maps[1], maps[0])
    assert torch.equal(maps[2], maps[0])


@EACH
def test_a_new_keyframe_and_one_without_edges_are_not_weighed(module: Any, started: Start) -> None:
    model, plain = _model(module, residual_gain=0.3), _model(module)
    view, other = _measured(started(model)), started(plain)
    assert torch.equal(view.uncertainty, other.uncertainty)
    some = view.ii != 2
    part = {name: getattr(view, name)[some] for name in ("ii", "jj", "target", "confidence")}
    model.update(replace(view, **part))
    plain.update(replace(other, ii=part["ii"], jj=part["jj"]))
    assert torch.allclose(view.uncertainty[2], other.uncertainty[2], atol=1e-6)
    assert not torch.allclose(view.uncertainty[1], other.uncertainty[1], atol=1e-2)
    model.append(view, 1)
    plain.append(other, 1)
    assert torch.allclose(view.uncertainty[1], other.uncertainty[1], atol=1e-6)


def test_nothing_is_kept_twice_unless_it_is_asked_for() -> None:
    few = {f.name for f in _model(affine_softplus).fields}
    more = {f.name for f in _model(affine_softplus, smooth=1, tolerance=0.1).fields}
    assert few < more
    assert len(more) == len(few) + 3


def test_calibration_leaves_similar_pictures_alone_and_scales_the_rest() -> None:
    xy = torch.rand(2, 2, 60, generator=torch.Generator().manual_seed(1)) * 5
    valid = torch.ones(2, 60, dtype=torch.bool)
    valid[1, ::2] = False
    samples = objective.make_samples(xy, valid, 10, torch.tensor([0, 1]), torch.tensor([1, 0]))
    cosine = torch.stack([torch.full((60,), 0.95), torch.full((60,), 0.6)])
    cosine[:, ::7] -= 0.3
    found = objective.calibrated(cosine, samples, 0.1)
    assert torch.allclose(found[0], cosine[0])
    assert torch.allclose(1 - found[1], (1 - cosine[1]) * 0.25, atol=1e-6)
    nothing = samples.of(torch.tensor([0]))
    outside = objective.Samples(
        nothing.source, nothing.place, nothing.first, nothing.steps, nothing.weights,
        torch.zeros_like(nothing.inside),
    )  # fmt: skip
    assert torch.equal(objective.calibrated(cosine[:1], outside, 0.1), cosine[:1])


@EACH
def test_calibration_opens_a_picture_that_is_alike_nowhere(module: Any, started: Start) -> None:
    def mean(bulk: float) -> float:
        model = _model(module, bulk=bulk)
        view = started(model)
        noise = torch.randn(view.features.shape, generator=torch.Generator().manual_seed(3))
        view.features.add_(0.6 * noise)
        for index in range(len(view.features)):
            model.append(view, index)
        for _ in range(60):
            model.update(view)
        return float(view.uncertainty[:, :, :4].mean())

    assert mean(0.05) < mean(0.0) - 0.01
