"""The model `affine-softplus`: its step is the published one, and each form of it is an option."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from droidw.errors import ConfigError
from droidw.interfaces.uncertainty import UncertaintyModel, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty._affine import affine, affine_gradient
from droidw_plugins.uncertainty.affine_softplus import COMPONENT, AffineSoftplusOptions
from droidw_plugins.uncertainty.none import COMPONENT as NONE

Start = Callable[..., UncertaintyView]
N, C, H, W = 6, 8, 6, 7
F64 = torch.float64


def _model(seed: int = 0, **options: object) -> UncertaintyModel:
    return COMPONENT.factory(
        AffineSoftplusOptions(**options),  # type: ignore[arg-type]
        BuildContext(torch.device("cpu"), seed=seed),
    )


def _theta(model: UncertaintyModel) -> Tensor:
    theta = model.state_dict()["theta"]
    assert isinstance(theta, Tensor)
    return theta


def test_one_step_is_the_published_formula(view_of: Start) -> None:
    # Every frame identical: rho = 0 on all pairs, so that only prior and weight decay act.
    model = _model(seed=4)
    view = view_of(model)
    view.features[:] = view.features[:1]
    for index in range(N):
        model.append(view, index)
    theta = _theta(model).double()
    rows = view.features.flatten(2).transpose(1, 2).double()
    y = rows @ theta[:-1] + theta[-1]
    u = torch.log(1.1 + torch.exp(y))
    assert torch.allclose(view.uncertainty.flatten(1).double(), u, atol=1e-5)
    J = 0.05 / (u + 1)
    sigma = 1 / (1 + 1.1 * torch.exp(-y))
    g = torch.cat([torch.einsum("kp,kpc->kc", J * sigma, rows), (J * sigma).sum(1)[:, None]], 1)
    expected = theta - 0.1 * (g / (H * W)).mean(0) - 0.002 * theta
    model.update(view)
    assert torch.allclose(_theta(model).double(), expected, atol=1e-5)
    renewed = torch.log(1.1 + torch.exp(rows @ expected[:-1] + expected[-1]))
    assert torch.allclose(view.uncertainty.flatten(1).double(), renewed, atol=1e-5)


def test_the_papers_form_is_gradient_descent_on_one_energy(started: Start) -> None:
    # Sums instead of means, all edges, no threshold, no bias, plain softplus: the step must be
    # the derivative of the energy of the paper, here by autograd from the definitions.
    lr = 1e-3
    model = _model(
        seed=2, lr=lr, gamma_data=1.0, softplus_offset=0.0, bias=False, min_gap=1,
        similarity_threshold=-1.0, similarity_floor=-1.0, average=False, weight_decay=0.01,
    )  # fmt: skip
    view = started(model)
    theta = _theta(model).double().requires_grad_()
    rows = view.features.flatten(2).transpose(1, 2).double()
    u = torch.nn.functional.softplus(rows @ theta[:-1] + theta[-1])
    # The camera stands still: each cell meets itself in the other frame.
    cosine = torch.nn.functional.cosine_similarity(rows[view.ii], rows[view.jj], dim=2)
    energy = ((1 - cosine) / (u[view.ii] * u[view.jj])).sum() + 0.05 * torch.log(u + 1).sum()
    (g,) = torch.autograd.grad(energy, theta)
    g[-1] = 0.0
    expected = theta.detach() - lr * g - 0.01 * theta.detach()
    model.update(view)
    assert torch.allclose(_theta(model).double(), expected, atol=1e-5)


@pytest.mark.parametrize("decoupled", [True, False])
def test_gradient_against_autograd(decoupled: bool) -> None:
    generator = torch.Generator().manual_seed(3)
    xy = torch.rand(4, 2, 20, generator=generator, dtype=F64) * 5 - 0.5
    valid = torch.rand(4, 20, generator=generator) > 0.1
    ii, jj = torch.tensor([0, 0, 1, 2]), torch.tensor([1, 2, 0, 0])
    samples = objective.make_samples(xy, valid, 5, ii, jj)
    rho = torch.rand(4, 20, generator=generator, dtype=F64) * samples.inside
    rows = torch.randn(3, 20, 6, generator=generator, dtype=F64)
    theta = (torch.randn(7, generator=generator, dtype=F64) * 0.3).requires_grad_()
    y = rows @ theta[:-1] + theta[-1]
    u = objective.softplus(y, 0.1)
    energy = objective.pair_energy(u, rho, samples, decoupled) + 0.05 * torch.log(u + 1).sum()
    (expected,) = torch.autograd.grad(energy, theta)
    y, u = affine(rows, theta.detach()), u.detach()
    pair, _ = objective.pair_gradient(u, rho, samples, decoupled)
    weight = (pair + 0.05 / (u + 1)) * objective.softplus_slope(y, 0.1)
    found = affine_gradient(weight, rows)
    assert float((found - expected).abs().max()) < 1e-6 * float(expected.abs().max())
    without = affine_gradient(weight, rows, bias=False)
    assert torch.equal(without[:-1], found[:-1])
    assert float(without[-1]) == 0.0


def test_start_is_seeded_and_scaled(started: Start) -> None:
    a, b, other = _model(1), _model(1), _model(2)
    for model in (a, b, other):
        started(model)
    assert torch.equal(_theta(a), _theta(b))
    assert not torch.equal(_theta(a), _theta(other))
    assert float(_theta(a)[-1]) == 0.0
    assert 0.1 < float(_theta(a)[:-1].std()) * C**0.5 < 3.0


def test_state_does_not_fit_other_features(view_of: Start, started: Start) -> None:
    model = _model(seed=3)
    started(model)
    copy = _model(seed=8)
    copy.load_state_dict(model.state_dict())
    with pytest.raises(ConfigError, match="8 feature channels, but the extractor gives 5"):
        copy.append(view_of(copy, channels=5), 0)
    copy.load_state_dict({})
    assert copy.state_dict() == {}


def test_weight_decay_and_bias_options(started: Start) -> None:
    def norm(**options: object) -> float:
        model = _model(**options)
        view = started(model)
        for _ in range(40):
            model.update(view)
        return float(_theta(model).norm())

    assert norm(weight_decay=0.05) < norm() < norm(weight_decay=0.0)
    model = _model(bias=False)
    view = started(model)
    model.update(view)
    assert float(_theta(model)[-1]) == 0.0


def test_start_without_noise_trusts_every_cell_alike(started: Start) -> None:
    model = _model(init_scale=0.0)
    view = started(model)
    assert torch.allclose(view.uncertainty, torch.tensor(0.74194), atol=1e-5)


def test_without_prior_nothing_pulls_u_down(started: Start) -> None:
    def mean(gamma_prior: float) -> float:
        model = _model(gamma_prior=gamma_prior, weight_decay=0.0, init_scale=0.0, lr=1.0)
        view = started(model)
        for _ in range(100):
            model.update(view)
        return float(view.uncertainty.mean())

    assert mean(0.0) > mean(0.05) + 0.1


def test_none_trusts_everything(view_of: Start) -> None:
    model = NONE.factory(NONE.options(), BuildContext(torch.device("cpu")))
    view = view_of(model, channels=0)
    view.uncertainty[:] = 5.0
    for index in range(N):
        model.append(view, index)
    assert model.update(view).energy == 0.0
    assert float(view.uncertainty.abs().max()) == 0.0
    model.load_state_dict(model.state_dict())
