"""What the suite catches of models that begin with what can move."""

from dataclasses import replace

import pytest

from droidw.testing import conformance
from droidw_plugins.uncertainty.affine_softplus import COMPONENT


def begins_once(options, context):
    """`affine-softplus` that takes what it is told a second time for what it knows already."""
    model = COMPONENT.factory(options, context)
    begin, told = model.begin, []

    def only_once(view, movable):
        if not told:
            begin(view, movable)
        told.append(movable)

    model.begin = only_once
    return model


def test_a_model_that_begins_once_is_caught():
    made = replace(COMPONENT, name="made-up", factory=begins_once)
    with pytest.raises(AssertionError, match="breaks clause 'begins-anew'"):
        conformance.check_uncertainty_model(made, options=COMPONENT.options(movable_gain=8.0))


@pytest.mark.parametrize(("claim", "method"), [("begins", "begin"), ("renews", "renew")])
def test_a_model_that_only_says_that_it_begins_is_caught(claim, method):
    class Claims:
        """`affine-softplus` without one of its methods."""

        def __init__(self, model):
            self.fields, self.append, self.update = model.fields, model.append, model.update
            self.state_dict, self.load_state_dict = model.state_dict, model.load_state_dict
            setattr(self, claim, True)

    made = replace(
        COMPONENT,
        name="made-up",
        factory=lambda options, context: Claims(COMPONENT.factory(options, context)),
    )
    with pytest.raises(AssertionError, match=rf"breaks clause '{claim}'.*no method {method}\("):
        conformance.check_uncertainty_model(made)
