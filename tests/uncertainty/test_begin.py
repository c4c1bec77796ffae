"""Where `affine-softplus` begins with what can move, and when it learns."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
import torch

from droidw.interfaces.uncertainty import UncertaintyView
from droidw.plugin.component import BuildContext
from droidw.solve.weights import gate
from droidw_plugins.uncertainty._affine import AffineSoftplus
from droidw_plugins.uncertainty._regression import Regression
from droidw_plugins.uncertainty.affine_softplus import AffineSoftplusOptions

Start = Callable[..., UncertaintyView]


def _model(**options: float) -> AffineSoftplus:
    given = {"init_scale": 0.0, **options}
    return AffineSoftplus(
        AffineSoftplusOptions(**given),  # type: ignore[arg-type]
        BuildContext(torch.device("cpu")),
    )


def _likely(view: UncertaintyView) -> torch.Tensor:
    """0.2 on the left and 0.8 in the three columns that change."""
    movable = torch.full_like(view.uncertainty, 0.2)
    movable[:, :, 4:] = 0.8
    return movable


def test_begins_with_what_can_move(started: Start) -> None:
    model = _model(movable_gain=8.0)
    view = started(model)
    assert model.begins and not _model().begins
    model.begin(view, _likely(view))
    still, moves = view.uncertainty[:, :, :4], view.uncertainty[:, :, 4:]
    assert float(still.max()) < 0.8 < float(moves.mean())
    assert float(gate(still).min()) == 1.0


def test_decays_to_where_it_began(started: Start) -> None:
    # Without a loss only weight decay acts: to the start with `begin`, else to zero.
    model = _model(movable_gain=8.0, gamma_data=0.0, gamma_prior=0.0, weight_decay=0.5)
    view = started(model)
    model.begin(view, _likely(view))
    home = model.state_dict()["home"]
    model.load_state_dict({**model.state_dict(), "theta": torch.zeros_like(home)})
    for _ in range(30):
        model.update(view)
    assert torch.allclose(model.state_dict()["theta"], home, atol=1e-5)


def test_a_restored_model_knows_where_it_began(started: Start) -> None:
    model = _model(movable_gain=8.0, weight_decay=0.1)
    view = started(model)
    model.begin(view, _likely(view))
    other = _model(movable_gain=8.0, weight_decay=0.1)
    other.load_state_dict(model.state_dict())
    copied = dataclasses.replace(
        view,
        uncertainty=view.uncertainty.clone(),
        fields={k: v.clone() for k, v in view.fields.items()},
    )
    model.update(view)
    other.update(copied)
    assert torch.equal(model.state_dict()["theta"], other.state_dict()["theta"])


def test_what_comes_in_later_takes_part_in_the_start(started: Start) -> None:
    model = _model(movable_gain=8.0, movable_keep=0.9)
    view = started(model)
    assert model.renews and not _model(movable_gain=8.0).renews and not _model().renews
    before = model.state_dict()
    model.renew(view, 2, _likely(view)[2])  # before it began there is nothing to renew
    assert torch.equal(model.state_dict()["theta"], before["theta"]) and "home" not in before
    first = dataclasses.replace(view, frames=view.frames[:1])
    model.begin(first, _likely(view))
    state = model.state_dict()
    learned = torch.linspace(-0.1, 0.1, len(state["home"]))
    model.load_state_dict({**state, "theta": state["home"] + learned})
    model.renew(view, 1, 0.4 * _likely(view)[1])
    renewed = model.state_dict()
    assert torch.allclose(renewed["theta"] - renewed["home"], learned, atol=1e-5)
    # What the second keyframe says counts, and nine tenths of what the first one did.
    rows = view.features[:2].flatten(2).transpose(1, 2)
    y = torch.stack([_likely(view)[0], 0.4 * _likely(view)[1]]).flatten(1)
    due = Regression.of(rows[:1], y[:1]).and_then(Regression.of(rows[1:], y[1:]), 0.9).theta()
    due = 8.0 * due
    due[-1] -= 8.0 * 0.55
    assert torch.allclose(renewed["home"], due, atol=1e-4)
    other = _model(movable_gain=8.0, movable_keep=0.9)
    other.load_state_dict(renewed)
    for each in (model, other):
        each.renew(view, 2, _likely(view)[2])
    assert torch.equal(model.state_dict()["theta"], other.state_dict()["theta"])


@pytest.mark.parametrize("lost", [True, False])
def test_learns_where_most_of_what_counts_agrees(started: Start, lost: bool) -> None:
    always, held = (_model(lr=0.3, movable_gain=8.0, learn_majority=m) for m in (0.0, 0.6))
    found = []
    for model in (always, held):
        view = started(model)
        model.begin(view, _likely(view))
        y, x = torch.meshgrid(torch.arange(6.0), torch.arange(7.0), indexing="ij")
        target = torch.stack([x, y], -1).expand(len(view.ii), -1, -1, -1).clone()
        # The columns that change are measured elsewhere, and the rest too, where all is lost.
        target[:, :, 0 if lost else 4 :] += 2.0
        view.uncertainty[:, :, 4:] = 2.0
        model.update(dataclasses.replace(view, target=target, gate=gate))
        found.append(model.state_dict()["theta"])
    home = held.state_dict()["home"]
    assert float((found[0] - home).abs().max()) > 1e-4
    assert torch.equal(found[1], home if lost else found[0])


def test_a_model_that_began_with_nothing_learns_always(started: Start) -> None:
    found = []
    for model in (_model(lr=0.3), _model(lr=0.3, learn_majority=0.6)):
        view = started(model)
        model.update(dataclasses.replace(view, target=view.target + 50.0, gate=gate))
        found.append(model.state_dict()["theta"])
    assert torch.equal(*found) and float(found[0].abs().max()) > 0
