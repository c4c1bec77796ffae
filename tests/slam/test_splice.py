"""Two paths of the same keyframes, put together from the better pieces of both."""

from __future__ import annotations

from itertools import pairwise, product
from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import DroidwConfig
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import exp, inv, mul
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.path import Path
from droidw.slam.splice import lead, pieces, spliced, support
from droidw.slam.timing import Stopwatch

H, W, COUNT = 6, 8, 10
GRID, INTRINSICS = Grid(H, W, 8, 3.5), torch.tensor([60.0, 60.0, 31.5, 23.5])
OPEN = torch.ones(COUNT, H, W)
PIECE = 1.0


@pytest.fixture
def truth(arc, waves):
    """The right path."""
    return path(arc(COUNT), waves(COUNT, H, W))


def path(T_cw, disps, mark=0):
    """A path; damping and full maps tell keyframes and paths apart by `mark`."""
    number = torch.arange(len(T_cw)) + mark
    damping = number[:, None, None].expand_as(disps).float()
    return Path(T_cw, disps, damping, tuple(number.tolist()))


def scaled(one, scale, at=None, mark=0):
    """The same path `scale` times larger, first brought to another world by pose `at`."""
    T_cw = one.T_cw if at is None else mul(one.T_cw, at.expand_as(one.T_cw))
    T_cw = torch.cat([T_cw[:, :3] * scale, T_cw[:, 3:]], 1)
    return path(T_cw, one.disps / scale, mark)


def relative(T_cw):
    return mul(T_cw, inv(T_cw[:1]).expand_as(T_cw))


def worth(ahead, taken):
    """What `pieces` is to make as large as can be."""
    gained = sum(value for value, now in zip(ahead.tolist(), taken, strict=True) if now)
    return gained - PIECE * sum(now and not before for before, now in pairwise([False, *taken]))


def test_lead_is_a_share_of_the_mean():
    one, other = torch.tensor([3.0, 1.0, 0.0]), torch.tensor([1.0, 3.0, 0.0])
    assert lead(one, other).tolist() == pytest.approx([1.0, -1.0, 0.0])


@pytest.mark.parametrize("seed", range(20))
def test_pieces_are_the_best_of_all(seed):
    draw = torch.Generator().manual_seed(seed)
    for count in range(1, 10):
        ahead = 0.7 * torch.randn(count, generator=draw, dtype=torch.float64)
        best = max(worth(ahead, taken) for taken in product([False, True], repeat=count))
        assert worth(ahead, pieces(ahead)) == pytest.approx(best)


def test_little_leads_are_no_reason_to_change():
    assert not any(pieces(torch.tensor([0.1, 0.1, 0.1, -0.1, 0.1, 0.1, 0.1])))
    ahead = torch.tensor([-0.1, -0.1, 0.6, 0.6, -0.1, -0.1])
    assert pieces(ahead) == [False, False, True, True, False, False]


def test_the_same_path_in_another_scale_and_world_is_joined_without_a_trace(truth):
    at = exp(torch.tensor([0.3, -0.2, 0.5, 0.1, 0.4, -0.2]))
    other = scaled(truth, 2.5, at, mark=100)
    taken = [False, False, True, True, True, False, True, False, False]
    joined = spliced(truth, other, taken, OPEN)
    assert torch.allclose(joined.T_cw, truth.T_cw, atol=1e-5)
    assert torch.allclose(joined.disps, truth.disps, atol=1e-5)
    # A keyframe comes from the same path as the motion that leads to it.
    assert joined.full == (0, 1, 2, 103, 104, 105, 6, 107, 8, 9)
    assert tuple(joined.damping[:, 0, 0].tolist()) == joined.full
    # From the first interval on, it is in the scale and world of the other one.
    begun = spliced(truth, other, [True, *taken[1:]], OPEN)
    assert torch.allclose(begun.T_cw, other.T_cw, atol=1e-5)
    assert torch.allclose(begun.disps, other.disps, atol=1e-5)


def test_only_what_is_open_tells_the_scale_if_anything_is(truth):
    other = scaled(truth, 2.0)
    other.disps[:, :, W // 2 :] *= 7.0  # of what moves
    taken = [False] * 4 + [True] * 5
    half = OPEN.clone()
    half[:, :, W // 2 - 1 :] = 0.0
    joined = spliced(truth, other, taken, half)
    assert torch.allclose(joined.T_cw, truth.T_cw, atol=1e-5)
    other.disps[4] = other.disps[4, 0, 0]
    closed = spliced(truth, scaled(truth, 2.0), taken, torch.zeros_like(OPEN))
    assert torch.allclose(closed.T_cw, truth.T_cw, atol=1e-5)


def test_where_no_depth_is_known_scales_are_left_alone(truth):
    other = path(truth.T_cw, truth.disps.clone())
    other.disps[4] = 0.0
    joined = spliced(truth, other, [False] * 4 + [True] * 5, OPEN)
    assert torch.allclose(joined.T_cw, truth.T_cw, atol=1e-5)


@pytest.fixture
def optimiser(truth, stored):
    """Measures exactly."""

    def measured(request):
        ii, jj = torch.tensor(request.ii), torch.tensor(request.jj)
        target, _ = reproject(truth.T_cw, truth.disps, GRID.intrinsics(INTRINSICS), ii, jj)
        return EdgeUpdate(
            target, torch.ones_like(target), torch.zeros(COUNT, H, W), list(range(COUNT))
        )

    session = SimpleNamespace(update=measured)
    parts = Parts(None, None, None, None, SimpleNamespace(session=lambda _: session))
    store = stored(GRID, INTRINSICS, truth.T_cw, truth.disps)
    return Optimiser(store, parts, DroidwConfig().weighting, Stopwatch())


def test_support_says_where_a_path_is_wrong(optimiser, truth):
    right = support(optimiser, truth)
    assert right.shape == (COUNT - 1,)
    assert right.dtype == torch.float64
    # Seen from the fifth keyframe on, the world has moved.
    off = exp(torch.tensor([0.3, 0.2, 0.0, 0.0, 0.1, 0.0])).expand(COUNT - 5, -1)
    bent = path(torch.cat([truth.T_cw[:5], mul(truth.T_cw[5:], off)]), truth.disps)
    wrong = lead(support(optimiser, bent), right)
    assert wrong.argmin() == 4
    assert wrong[4] < -0.5
    assert wrong[[0, 1, 7, 8]].abs().max() < 1e-6
    optimiser.store["unmasked"][:] = 0.5
    assert torch.allclose(support(optimiser, truth), 0.5 * right)


def test_support_leaves_the_store_with_the_path(optimiser, truth):
    other = scaled(truth, 2.0, mark=7)
    support(optimiser, other)
    left = Path.of(optimiser.store)
    assert torch.equal(left.T_cw, other.T_cw)
    assert torch.equal(left.disps, other.disps)
    assert torch.equal(left.damping, other.damping)
    assert left.full == other.full


def test_turned_is_the_same_path_from_its_end(truth):
    first = exp(torch.tensor([0.1, 0.2, 0.3, 0.0, 0.1, 0.0]))
    turned = truth.turned(first)
    assert torch.allclose(turned.T_cw[0], first, atol=1e-6)
    assert torch.allclose(relative(turned.T_cw), relative(truth.T_cw.flip(0)), atol=1e-5)
    assert torch.equal(turned.disps, truth.disps.flip(0))
    assert turned.full == truth.full[::-1]
    assert torch.allclose(turned.turned(truth.T_cw[0]).T_cw, truth.T_cw, atol=1e-5)
