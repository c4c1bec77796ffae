"""Keyframes tracked from the last to the first."""

from __future__ import annotations

import pytest
import torch

from droidw.geometry.se3 import inv, mul
from droidw.slam.backwards import track_backwards


def relative(T_cw):
    """Every pose seen from the first one, [N,7]."""
    return mul(T_cw, inv(T_cw[:1]).expand_as(T_cw))


def track(optimiser, config, stopped=lambda: False):
    told = []
    back = track_backwards(optimiser, config, lambda *news: told.append(news), stopped)
    return back, told


def test_the_way_back_finds_what_the_way_there_lost(optimiser, config, truth):
    before = optimiser.store.T_cw.clone()
    count = len(before)
    back, told = track(optimiser, config)
    assert torch.equal(optimiser.store.T_cw, before)
    assert torch.allclose(back.T_cw[0], before[0], atol=1e-6)
    assert back.agreement > 0.99
    back.write_to(optimiser.store)
    found, right = relative(optimiser.store.T_cw), relative(truth[0])
    # Monocular: all but the scale.
    scale = (found[:, :3] * right[:, :3]).sum() / right[:, :3].square().sum()
    assert torch.allclose(found[:, :3] / scale, right[:, :3], atol=5e-3)
    assert torch.allclose(found[:, 3:], right[:, 3:], atol=5e-3)
    assert told == [(k, count + 2) for k in [*range(count), count + 1, count + 2]]


def test_all_but_the_path_stays(optimiser, config):
    store = optimiser.store
    count, height, width = store.disps.shape
    known = 0.01 * torch.arange(1.0, 1 + count)[:, None, None].expand(count, height, width)
    store["uncertainty"].copy_(known)
    first, times = store.T_cw[0].clone(), store.times()
    back, _ = track(optimiser, config)
    back.write_to(store)
    assert torch.allclose(store.T_cw[0], first, atol=1e-6)
    assert store.times() == times
    assert [info.index for info in store.infos] == list(range(count))
    assert torch.equal(store["uncertainty"], known)


# Of fourteen keyframes the first four warm it up; two update steps follow.
@pytest.mark.parametrize("after", [0, 3, 13, 14, 15])
def test_a_run_that_is_to_end_gives_it_up(optimiser, config, after):
    asked = iter(range(len(optimiser.store) + 3))
    back, told = track(optimiser, config, lambda: next(asked) >= after)
    assert back is None
    assert len(told) == after


def test_too_few_keyframes_are_left_alone(optimiser, config):
    config.frontend.warmup = len(optimiser.store)
    assert track(optimiser, config) == (None, [])
