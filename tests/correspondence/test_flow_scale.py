"""Global adjustment measures at full size: finer than the window, and by an engine of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from droidw.testing.scenes import Scene, SceneSpec


@pytest.fixture(scope="module")
def room():
    return Scene(SceneSpec(208, 160, 12, 30.0, 3, False, "handheld"))


@pytest.fixture(scope="module")
def pictures(frame, room):
    """The first and the tenth of the room."""
    grey = [room.render(k).image.astype(np.float32).mean(-1) for k in (0, 9)]
    return [frame(k, picture) for k, picture in enumerate(grey)]


def test_global_adjustment_is_measured_finer_than_the_window(operator, question, pictures, room):
    part = operator()
    asked = replace(question(part, pictures), informed=True)
    centres = asked.payload(0).centres.astype(np.float64)
    truth = room.correspond(0, 9, centres)

    def error(purpose):
        found = part.session(purpose).update(asked)
        target = found.target[0].numpy() * part.stride + part.offset
        known = truth.visible & (found.confidence[0, ..., :2].numpy().min(-1) > 0.3)
        assert known.mean() > 0.4
        return float(np.median(np.abs(target - truth.target)[known]))

    window, fine = error("window"), error("global")

    assert fine < 0.7 * window
    assert fine < 0.1  # pixels


def test_scales_do_not_share_an_engine(operator, question, pictures):
    def targets(*purposes, **options):
        part = operator(**options)
        asked = replace(question(part, pictures), informed=True)
        return [part.session(purpose).update(asked).target for purpose in purposes]

    window, fine = targets("window", "global")
    assert torch.equal(window, targets("window")[0])
    assert torch.equal(fine, targets("global")[0])
    assert not torch.equal(window, fine)
    same = targets("window", "global", global_scale=1, global_refinement=3, warp=False)
    assert torch.equal(*same)
    assert torch.equal(same[0], window)
