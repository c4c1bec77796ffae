"""When uncertainty models are asked to calibrate similarities."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import WeightingConfig
from droidw.slam.optimise import Optimiser
from droidw.slam.timing import Stopwatch


class Store(dict):
    """As much of a keyframe store as a view looks at."""

    device = torch.device("cpu")
    disps = T_cw = intrinsics = torch.zeros(0, 3, 4)
    grid = SimpleNamespace(height=3, width=4)

    def extra(self):
        return {}


@pytest.mark.parametrize(
    ("similarity", "extractor", "published", "asked"),
    [
        ("matched", {}, False, True),
        ("matched", {"calibrated": False}, False, True),
        ("matched", {"calibrated": True}, False, False),
        ("matched", {}, True, False),
        ("raw", {}, False, False),
    ],
)
def test_calibration_is_asked_for_where_it_is_needed(similarity, extractor, published, asked):
    features = SimpleNamespace(dim=3, **extractor)
    parts = SimpleNamespace(features=features, uncertainty=None, correspondence=None)
    store = Store(features=torch.zeros(0, 3, 3, 4), uncertainty=torch.zeros(0, 3, 4))
    weighting = WeightingConfig(similarity=similarity)
    view = Optimiser(store, parts, weighting, Stopwatch(), published).view()
    assert view.calibrate is asked
