"""The model `affine-softplus`: it learns which features move, and is refused without features."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from droidw.errors import ConfigError
from droidw.interfaces.uncertainty import UncertaintyModel, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw_plugins.uncertainty.affine_softplus import COMPONENT, AffineSoftplusOptions
from droidw_plugins.uncertainty.none import COMPONENT as NONE

N, C, H, W = 6, 8, 6, 7


def _model(seed: int = 0, **options: object) -> UncertaintyModel:
    return COMPONENT.factory(
        AffineSoftplusOptions(**options),  # type: ignore[arg-type]
        BuildContext(torch.device("cpu"), seed=seed),
    )


def _view(model: UncertaintyModel, channels: int = C, seed: int = 0) -> UncertaintyView:
    """A camera that stands still. Features are alike in all frames, except in the three right
    columns, where they change in all channels but the first, which tells them apart."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(1, channels, H, W, generator=generator).repeat(N, 1, 1, 1)
    features[:, 1:, :, 4:] = torch.randn(N, max(channels - 1, 0), H, 3, generator=generator)
    if channels:
        features[:, 0] = -2.0
        features[:, 0, :, 4:] = 2.0
    T_cw = torch.zeros(N, 7)
    T_cw[:, 6] = 1.0
    ii, jj = torch.meshgrid(torch.arange(N), torch.arange(N), indexing="ij")
    keep = (ii != jj).flatten()
    ii, jj = ii.flatten()[keep], jj.flatten()[keep]
    sizes = {"h": H, "w": W, "c": channels}
    fields = {
        f.name: torch.full((N, *(sizes[s] if isinstance(s, str) else s for s in f.shape)), f.fill)
        for f in model.fields
    }
    return UncertaintyView(
        features=features,
        uncertainty=torch.zeros(N, H, W),
        fields=fields,
        T_cw=T_cw,
        disps=torch.ones(N, H, W),
        intrinsics=torch.tensor([8.0, 8.0, 3.0, 2.5]),
        ii=ii,
        jj=jj,
        target=torch.zeros(len(ii), H, W, 2),
        confidence=torch.ones(len(ii), H, W, 2),
        frames=torch.arange(N),
    )


def _started(model: UncertaintyModel, seed: int = 0) -> UncertaintyView:
    view = _view(model, seed=seed)
    for index in range(N):
        model.append(view, index)
    return view


def _theta(model: UncertaintyModel) -> Tensor:
    theta = model.state_dict()["theta"]
    assert isinstance(theta, Tensor)
    return theta


@pytest.mark.parametrize("options", [{}, {"decoupled": False}, {"affine": False}, {"refresh": 3}])
def test_moving_cells_become_uncertain_and_still_ones_do_not(options: dict[str, object]) -> None:
    model = _model(**options)
    view = _started(model)
    first = model.update(view).energy
    for _ in range(150):
        report = model.update(view)
    still, moving = view.uncertainty[:, :, :4], view.uncertainty[:, :, 4:]
    assert float(moving.mean()) > 1.0
    assert float(still.mean()) < 0.6
    assert report.energy < first
    assert 0.4 < report.facts["similar"] < 0.8


def test_one_step_is_the_published_formula() -> None:
    # Every frame identical: rho = 0 on all pairs, so that only prior and weight decay act.
    model = _model(seed=4)
    view = _view(model)
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


def test_start_is_seeded_and_scaled() -> None:
    a, b, other = _model(1), _model(1), _model(2)
    for model in (a, b, other):
        _started(model)
    assert torch.equal(_theta(a), _theta(b))
    assert not torch.equal(_theta(a), _theta(other))
    assert float(_theta(a)[-1]) == 0.0
    assert 0.1 < float(_theta(a)[:-1].std()) * C**0.5 < 3.0


def test_two_runs_give_the_same_bytes_and_edge_order_does_not_matter() -> None:
    def run(order: Tensor | None) -> Tensor:
        model = _model()
        view = _started(model)
        if order is not None:
            view = UncertaintyView(**{**view.__dict__, "ii": view.ii[order], "jj": view.jj[order]})
        for _ in range(10):
            model.update(view)
        return view.uncertainty

    whole = run(None)
    assert torch.equal(run(None), whole)
    shuffled = torch.randperm(N * (N - 1), generator=torch.Generator().manual_seed(1))
    assert torch.allclose(run(shuffled), whole, atol=1e-5)


def test_only_the_asked_frames_are_renewed() -> None:
    model = _model()
    view = _started(model)
    before = view.uncertainty.clone()
    model.update(UncertaintyView(**{**view.__dict__, "frames": torch.tensor([2, 4])}))
    changed = (view.uncertainty != before).flatten(1).any(1)
    assert changed.tolist() == [False, False, True, False, True, False]


def test_no_edges_leave_only_the_prior_and_no_frames_do_nothing() -> None:
    model = _model()
    view = _started(model)
    before = view.uncertainty.clone()
    none = view.ii[:0]
    empty = {"ii": none, "jj": none, "target": view.target[:0], "confidence": view.confidence[:0]}
    model.update(UncertaintyView(**{**view.__dict__, **empty, "frames": none}))
    assert torch.equal(view.uncertainty, before)
    report = model.update(UncertaintyView(**{**view.__dict__, **empty}))
    assert report.energy == 0.0
    assert float(view.uncertainty.mean()) < float(before.mean())


def test_broken_poses_do_not_spoil_the_parameters() -> None:
    model = _model()
    view = _started(model)
    view.T_cw[3] = float("nan")
    for _ in range(3):
        model.update(view)
    assert bool(torch.isfinite(_theta(model)).all())
    assert bool(torch.isfinite(view.uncertainty).all())
    view.T_cw[3] = view.T_cw[0]
    view.features[2, 0, 0, 0] = float("inf")
    for field in view.fields.values():
        field[2, 0, 0, 0] = float("inf")
    model.update(view)
    assert bool(torch.isfinite(_theta(model)).all())


def test_refresh_keeps_similarities_until_a_keyframe_is_appended() -> None:
    model = _model(refresh=10)
    view = _started(model)
    similar = model.update(view).facts["similar"]
    view.disps[:] = float("nan")  # would leave no pair at all
    assert model.update(view).facts["similar"] == similar
    model.append(view, N - 1)
    assert model.update(view).facts["pairs"] == 0.0


def test_state_survives_and_does_not_fit_other_features() -> None:
    model = _model(seed=3)
    view = _started(model)
    for _ in range(5):
        model.update(view)
    copy = _model(seed=8)
    copy.load_state_dict(model.state_dict())
    other = _view(copy)
    copy.append(other, 0)
    model.append(view, 0)
    assert torch.equal(other.uncertainty[0], view.uncertainty[0])
    with pytest.raises(ConfigError, match="8 feature channels, but the extractor gives 5"):
        copy.append(_view(copy, channels=5), 0)
    copy.load_state_dict({})
    assert copy.state_dict() == {}


def test_weight_decay_and_bias_options() -> None:
    def norm(**options: object) -> float:
        model = _model(**options)
        view = _started(model)
        for _ in range(40):
            model.update(view)
        return float(_theta(model).norm())

    assert norm(weight_decay=0.05) < norm() < norm(weight_decay=0.0)
    model = _model(bias=False)
    view = _started(model)
    model.update(view)
    assert float(_theta(model)[-1]) == 0.0


def test_without_features_it_is_refused() -> None:
    assert "features" in COMPONENT.capabilities
    model = _model()
    with pytest.raises(ConfigError, match="needs features"):
        model.append(_view(model, channels=0), 0)
    with pytest.raises(ConfigError, match="u_min"):
        _model(u_min=3.0)


def test_none_trusts_everything() -> None:
    model = NONE.factory(NONE.options(), BuildContext(torch.device("cpu")))
    view = _view(model, channels=0)
    view.uncertainty[:] = 5.0
    for index in range(N):
        model.append(view, index)
    assert model.update(view).energy == 0.0
    assert float(view.uncertainty.abs().max()) == 0.0
    model.load_state_dict(model.state_dict())


def test_start_without_noise_trusts_every_cell_alike() -> None:
    model = _model(init_scale=0.0)
    view = _started(model)
    assert torch.allclose(view.uncertainty, torch.tensor(0.74194), atol=1e-5)
