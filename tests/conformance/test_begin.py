"""What the suite catches of models that begin with what can move."""

from dataclasses import replace

import pytest

from droidw.testing import conformance
from droidw_plugins.uncertainty.affine_softplus import COMPONENT

BEGINS = COMPONENT.options(movable_gain=8.0)


def made_by(change):
    """`affine-softplus`, each model changed by `change(model)`."""

    def factory(options, context):
        model = COMPONENT.factory(options, context)
        change(model)
        return model

    return replace(COMPONENT, name="made-up", factory=factory)


def test_a_model_that_begins_anew_is_right():
    conformance.check_uncertainty_model(made_by(lambda model: None), options=BEGINS)


def test_a_model_that_begins_once_is_caught():
    """It takes what it is told a second time for what it knows already."""

    def once(model):
        begin = model.begin
        told = []

        def only_once(view, movable):
            if not told:
                begin(view, movable)
            told.append(movable)

        model.begin = only_once

    with pytest.raises(AssertionError, match="breaks clause 'begins-anew'"):
        conformance.check_uncertainty_model(made_by(once), options=BEGINS)
