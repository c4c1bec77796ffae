"""A path held apart from its store, and where it goes on to."""

from __future__ import annotations

import pytest
import torch

from droidw.geometry.se3 import exp, inv, mul
from droidw.slam.path import Path

COUNT, H, W = 6, 3, 4


@pytest.fixture
def going():
    """`going(s)`: a path whose motions and inverse depths change at a constant rate with s."""
    made = torch.Generator().manual_seed(5)
    start, rate = (torch.randn(COUNT - 1, 6, generator=made) * 0.1 for _ in range(2))
    first = exp(torch.randn(6, generator=made))
    disps = 1.0 + torch.rand(COUNT, H, W, generator=made)
    growth = 0.1 * torch.randn(COUNT, H, W, generator=made)

    def at(s):
        T_cw = [first]
        for motion in mul(exp(s * rate), exp(start)):
            T_cw.append(mul(motion, T_cw[-1]))
        return Path(torch.stack(T_cw), disps * (s * growth).exp(), disps * 0, (None,) * COUNT, 0.5)

    return at


@pytest.mark.parametrize("share", [0.0, 1.0, 2.5])
def test_a_path_goes_on_as_it_has_come(going, share):
    found, wanted = going(2.0).beyond(going(1.0), share), going(2.0 + share)
    apart = mul(found.T_cw, inv(wanted.T_cw))
    assert torch.allclose(apart[:, :6], torch.zeros(COUNT, 6), atol=1e-5)
    assert torch.allclose(found.disps, wanted.disps, atol=1e-5)
    assert found.agreement == 0.5
    assert torch.equal(found.T_cw[0], going(2.0).T_cw[0])


def test_no_depth_goes_on_by_more_than_a_factor_of_e_or_becomes_no_number(going):
    before, after = going(1.0), going(1.0)
    before.disps[0, 0, :3] = torch.tensor([1e-6, 0.0, -1.0])
    after.disps[0, 0, :3] = torch.tensor([1.0, 1.0, 1.0])
    found = after.beyond(before, 2.0).disps
    assert found[0, 0, 0] == pytest.approx(torch.e)
    assert found[0, 0, 1] == pytest.approx(torch.e)
    assert found[0, 0, 2] == 1.0
    assert torch.allclose(found[1:], after.disps[1:])
