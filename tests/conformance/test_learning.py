"""What the suite catches of models that learn from pairs of frames that lie farther apart."""

from dataclasses import replace

import pytest
import torch

from droidw.testing import conformance
from droidw_plugins.uncertainty.affine_softplus import COMPONENT as AFFINE
from droidw_plugins.uncertainty.per_pixel import COMPONENT as PER_PIXEL


def at_random(model):
    """Similarities that are others each time."""
    similarity = model._objective._similarity
    model._objective._similarity = lambda *a: similarity(*a) * torch.rand(())


def no_number(model):
    similarity = model._objective._similarity
    model._objective._similarity = lambda *a: similarity(*a) * float("nan")


def forgetful(model):
    """A state without the scale of similarities."""
    load, scale = model.load_state_dict, model._objective.scale
    model._objective.scale.load_state_dict = lambda state: None
    model.load_state_dict = lambda state: (load(state), setattr(model._objective, "scale", scale))


def stale(model):
    """Pairs of before a keyframe that came in between."""
    objective, append = model._objective, model._objective.append

    def keeps(view, index):
        kept = objective._pairs
        append(view, index)
        objective._pairs = kept

    objective.append = keeps


@pytest.mark.parametrize("component", [AFFINE, PER_PIXEL], ids=lambda c: c.name)
@pytest.mark.parametrize("fault", [at_random, no_number, forgetful, stale])
def test_a_model_with_a_fault_in_what_it_learns_from_is_caught(component, fault):
    def made(options, context):
        model = component.factory(options, context)
        fault(model)
        return model

    options = component.options(refresh=4)  # so that pairs are kept over several updates
    conformance.check_uncertainty_model(component, options=options)
    broken = replace(component, name="made-up", factory=made)
    with pytest.raises(AssertionError, match="breaks clause"):
        conformance.check_uncertainty_model(broken, options=options)
