"""What all learned models do alike: find what moves, repeat themselves, stand bad input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from droidw.errors import ConfigError
from droidw.interfaces.uncertainty import UncertaintyModel, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw.testing import conformance
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty import affine_softplus, mlp, per_pixel
from droidw_plugins.uncertainty._mlp import Layers, backward, forward

Start = Callable[..., UncertaintyView]
N = 6
F64 = torch.float64
MODELS = (affine_softplus, per_pixel, mlp)
EACH = pytest.mark.parametrize("module", MODELS, ids=lambda m: m.COMPONENT.name)


def _model(module: Any, seed: int = 0, **options: object) -> UncertaintyModel:
    component = module.COMPONENT
    model = component.factory(
        component.options(**options), BuildContext(torch.device("cpu"), seed=seed)
    )
    assert isinstance(model, UncertaintyModel)
    return model


@EACH
@pytest.mark.parametrize("options", [{}, {"decoupled": False}, {"refresh": 3}, {"tolerance": 0.1}])
def test_moving_cells_become_uncertain_and_still_ones_do_not(
    module: Any, options: dict[str, object], started: Start
) -> None:
    model = _model(module, **options)
    view = started(model)
    first = model.update(view).energy
    for _ in range(150):
        report = model.update(view)
    still, moving = view.uncertainty[:, :, :4], view.uncertainty[:, :, 4:]
    assert float(moving.mean()) > 1.0
    assert float(still.mean()) < 0.6
    assert report.energy < first
    assert 0.4 < report.facts["similar"] < 0.8


@EACH
def test_similarities_are_kept_by_keyframe_and_not_by_number(module: Any) -> None:
    component = module.COMPONENT
    conformance.check_uncertainty_model(component, options=component.options(tolerance=0.1))


@EACH
def test_two_runs_give_the_same_bytes_and_edge_order_does_not_matter(
    module: Any, started: Start
) -> None:
    def run(order: Tensor | None) -> Tensor:
        model = _model(module)
        view = started(model)
        if order is not None:
            view = replace(view, ii=view.ii[order], jj=view.jj[order])
        for _ in range(10):
            model.update(view)
        return view.uncertainty

    whole = run(None)
    assert torch.equal(run(None), whole)
    shuffled = torch.randperm(N * (N - 1), generator=torch.Generator().manual_seed(1))
    assert torch.allclose(run(shuffled), whole, atol=1e-5)


@EACH
def test_only_the_asked_frames_are_renewed(module: Any, started: Start) -> None:
    model = _model(module)
    view = started(model)
    before = view.uncertainty.clone()
    model.update(replace(view, frames=torch.tensor([2, 4])))
    changed = (view.uncertainty != before).flatten(1).any(1)
    assert changed.tolist() == [False, False, True, False, True, False]


@EACH
def test_no_edges_leave_only_the_prior_and_no_frames_do_nothing(
    module: Any, started: Start
) -> None:
    model = _model(module, tolerance=0.1)
    view = started(model)
    before = view.uncertainty.clone()
    none = view.ii[:0]
    empty = replace(view, ii=none, jj=none, target=view.target[:0], confidence=view.confidence[:0])
    model.update(replace(empty, frames=none))
    assert torch.equal(view.uncertainty, before)
    report = model.update(empty)
    assert report.energy == 0.0
    assert float(view.uncertainty.mean()) < float(before.mean())


@EACH
def test_broken_poses_and_features_do_not_spoil_the_model(module: Any, started: Start) -> None:
    model = _model(module)
    view = started(model)
    view.T_cw[3] = float("nan")
    for _ in range(3):
        model.update(view)
    assert bool(torch.isfinite(view.uncertainty).all())
    view.T_cw[3] = view.T_cw[0]
    view.features[2, 0, 0, 0] = float("inf")
    for field in view.fields.values():
        field[2, 0] = float("inf")
    model.update(view)
    assert bool(torch.isfinite(view.uncertainty).all())
    assert all(bool(torch.isfinite(value).all()) for value in model.state_dict().values())


@EACH
def test_refresh_keeps_similarities_until_a_keyframe_is_appended(
    module: Any, started: Start
) -> None:
    model = _model(module, refresh=10)
    view = started(model)
    similar = model.update(view).facts["similar"]
    view.disps[:] = float("nan")  # would leave no pair at all
    assert model.update(view).facts["similar"] == similar
    model.append(view, N - 1)
    assert model.update(view).facts["pairs"] == 0.0


@EACH
def test_tolerance_changes_nothing_while_nothing_moves_and_sees_what_does(
    module: Any, started: Start
) -> None:
    maps = []
    for tolerance in (0.0, 0.05):
        model = _model(module, tolerance=tolerance)
        view = started(model)
        for step in range(6):
            if step == 3:
                view.T_cw[2, 0] = 0.1  # 0.8 cells
            if step == 5:  # another keyframe takes the last place
                view.features[N - 1] = view.features[0].flip(-1)
                model.append(view, N - 1)
            model.update(view)
        maps.append(view.uncertainty.clone())
    assert torch.equal(maps[0], maps[1])


def test_tolerance_keeps_the_similarities_of_edges_that_hardly_move(started: Start) -> None:
    model = _model(affine_softplus, tolerance=0.05)
    view = started(model)
    similar = model.update(view).facts["similar"]
    for field in view.fields.values():
        if field.is_floating_point():
            field[:] = field.flip(0) * torch.randn(field.shape)  # seen only where taken again
    view.T_cw[2, 0] = 0.001  # 0.008 cells; a column of cells leaves the picture
    assert model.update(view).facts["similar"] == pytest.approx(similar, abs=0.01)
    view.T_cw[2, 0] = 0.1
    assert model.update(view).facts["similar"] < similar - 0.1


@EACH
def test_state_survives(module: Any, started: Start, view_of: Start) -> None:
    model = _model(module, seed=3)
    view = started(model)
    for _ in range(5):
        model.update(view)
    copy = _model(module, seed=8)
    copy.load_state_dict(model.state_dict())
    other = view_of(copy)
    copy.append(other, 0)
    model.append(view, 0)
    assert torch.equal(other.uncertainty[0], view.uncertainty[0])
    for _ in range(2):
        assert set(model.state_dict()) == set(copy.state_dict())
        assert all(torch.equal(copy.state_dict()[k], v) for k, v in model.state_dict().items())


@EACH
def test_without_features_it_is_refused(module: Any, view_of: Start) -> None:
    assert "features" in module.COMPONENT.capabilities
    model = _model(module)
    with pytest.raises(ConfigError, match=f"'{module.COMPONENT.name}' needs features"):
        model.append(view_of(model, channels=0), 0)


def test_per_pixel_stays_in_its_range_and_refuses_an_empty_one(started: Start) -> None:
    model = _model(per_pixel, lr=50.0)
    view = started(model)
    for _ in range(5):
        model.update(view)
    assert float(view.uncertainty.min()) == pytest.approx(0.1)
    assert float(view.uncertainty.max()) == pytest.approx(2.0)
    with pytest.raises(ConfigError, match="do not ascend"):
        _model(per_pixel, u_min=3.0)


def test_per_pixel_step_is_the_published_formula(started: Start) -> None:
    # u <- u - lr J with J of the objective; a still cell has no loss, so that only the prior acts.
    model = _model(per_pixel)
    view = started(model)
    model.update(view)
    expected = 0.742 - 0.1 * 0.05 / 1.742
    assert torch.allclose(view.uncertainty[:, :, :4], torch.tensor(expected), atol=1e-6)


@pytest.mark.parametrize("decoupled", [True, False])
def test_mlp_gradient_against_autograd(decoupled: bool) -> None:
    generator = torch.Generator().manual_seed(3)
    xy = torch.rand(4, 2, 20, generator=generator, dtype=F64) * 5 - 0.5
    valid = torch.rand(4, 20, generator=generator) > 0.1
    ii, jj = torch.tensor([0, 0, 1, 2]), torch.tensor([1, 2, 0, 0])
    samples = objective.make_samples(xy, valid, 5, ii, jj)
    rho = torch.rand(4, 20, generator=generator, dtype=F64) * samples.inside
    rows = torch.randn(60, 6, generator=generator, dtype=F64)
    vector = (torch.randn(4 * 8 + 1, generator=generator, dtype=F64) * 0.4).requires_grad_()
    layers = Layers.of(vector, 4)
    y = torch.relu(rows @ layers.first.T + layers.bias) @ layers.second + layers.offset
    u = objective.softplus(y, 0.1).view(3, 20)
    energy = objective.pair_energy(u, rho, samples, decoupled) + 0.05 * torch.log(u + 1).sum()
    (expected,) = torch.autograd.grad(energy, vector)
    layers, u = Layers.of(vector.detach(), 4), u.detach()
    found_y, hidden = forward(rows, layers)
    assert torch.allclose(found_y, y.detach(), atol=1e-12)
    pair, _ = objective.pair_gradient(u, rho, samples, decoupled)
    weight = (pair + 0.05 / (u + 1)).flatten() * objective.softplus_slope(found_y, 0.1)
    found = backward(weight, rows, hidden, layers)
    assert float((found - expected).abs().max()) < 1e-6 * float(expected.abs().max())


def test_mlp_start_is_seeded_and_its_state_tells_when_it_does_not_fit(started: Start) -> None:
    def weights(seed: int) -> Tensor:
        model = _model(mlp, seed, init_scale=1.0)
        started(model)
        found = model.state_dict()["weights"]
        assert isinstance(found, Tensor)
        return found

    assert torch.equal(weights(1), weights(1))
    assert not torch.equal(weights(1), weights(2))
    model = _model(mlp, hidden=4)
    started(model)
    other = _model(mlp, hidden=5)
    other.load_state_dict(model.state_dict())
    with pytest.raises(ConfigError, match=r"holds 41 numbers, but 8 feature channels and 5"):
        started(other)


def test_mlp_step_is_that_of_adamw(started: Start) -> None:
    # torch's AdamW multiplies the decay by the rate; ours is a share per step.
    model = _model(mlp, lr=0.02, weight_decay=0.001, init_scale=1.0, seed=5)
    started(model)
    weights = model.state_dict()["weights"].clone().requires_grad_()
    adam = torch.optim.AdamW([weights], lr=0.02, betas=(0.9, 0.99), weight_decay=0.001 / 0.02)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        weights.grad = torch.randn(weights.shape, generator=generator)
        model._adam(weights.grad.clone())  # type: ignore[attr-defined]
        adam.step()
    assert torch.allclose(model.state_dict()["weights"], weights.detach(), atol=1e-6)
