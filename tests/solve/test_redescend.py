"""The kernel that gives up what is far off, and what tells how wide it has to be."""

from __future__ import annotations

import pytest
import torch

from droidw.solve.kernel import median_length, redescend


def test_a_far_match_pulls_less_than_a_near_one() -> None:
    residual = torch.zeros(1, 1, 4, 2, dtype=torch.float64)
    residual[0, 0, :, 0] = torch.tensor([0.0, 0.5, 1.0, 5.0])
    weight = redescend(torch.ones_like(residual), residual, 0.5)
    assert weight[0, 0, :, 0].tolist() == pytest.approx([1.0, 0.5, 0.2, 1 / 101])
    pull = weight[..., 0] * residual[..., 0]
    assert pull.argmax() == 1
    assert torch.equal(weight[..., 0], weight[..., 1])


def test_a_match_is_judged_in_the_directions_in_which_it_is_known() -> None:
    # an edge at 45 degrees: all is known across it, nothing along it
    across = torch.tensor([0.5, 0.5, -0.5], dtype=torch.float64).expand(1, 1, 2, 3)
    residual = torch.tensor([[[[2.0, 2.0], [0.5, -0.5]]]], dtype=torch.float64)
    weight = redescend(across, residual, 1.0)
    assert torch.equal(weight[0, 0, 0], across[0, 0, 0])  # slipped along the edge: no fault of it
    # r^T W r = 0.5, and the mean of xx and yy is 0.5
    assert torch.allclose(weight[0, 0, 1], 0.5 * across[0, 0, 1])


def test_what_has_slipped_along_a_line_can_be_given_up_too() -> None:
    across = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(1, 1, 3, 3)
    residual = torch.tensor([[[[0.0, 4.0], [0.3, 0.4], [0.0, 0.0]]]], dtype=torch.float64)
    kept = redescend(across, residual, 1.0, slip=0.5)[0, 0, :, 0]
    # half of 4 along the line; across it r^T W r / 0.5 = 0.18, and a quarter of 0.25 besides
    assert kept.tolist() == pytest.approx([1 / 5, 1 / (1 + 0.18 + 0.0625), 1.0])
    assert torch.equal(redescend(across, residual, 1.0)[0, 0, 0], across[0, 0, 0])


def test_the_scale_of_weights_does_not_matter_and_nonsense_stays_to_be_counted() -> None:
    residual = torch.tensor([[[[0.3, 0.4], [float("nan"), 0.0], [1.0, 1.0]]]])
    weight = torch.tensor([[[[1.0, 1.0], [1.0, 1.0], [0.0, 0.0]]]])
    once, small = redescend(weight, residual, 0.5), redescend(1e-6 * weight, residual, 0.5)
    assert torch.allclose(small, 1e-6 * once)
    assert once[0, 0].tolist() == [[0.5, 0.5], [1.0, 1.0], [0.0, 0.0]]
    broken = redescend(torch.full_like(weight, float("nan")), residual, 0.5)
    assert bool(torch.isnan(broken).all())


def test_half_of_the_weight_lies_below_the_median_length() -> None:
    residual = torch.zeros(1, 1, 5, 2)
    residual[0, 0, :, 0] = torch.tensor([0.01, 0.02, 0.04, 3.0, 9.0])
    weight = torch.ones(1, 1, 5, 2)
    assert float(median_length(weight, residual)) == pytest.approx(0.04, rel=0.012)
    weight[0, 0, 3:] = 0.1  # far, and hardly known
    assert float(median_length(weight, residual)) == pytest.approx(0.02, rel=0.012)
    assert float(median_length(1e-6 * weight, 7 * residual)) == pytest.approx(0.14, rel=0.012)


def test_nothing_known_has_no_length_and_nonsense_does_not_count() -> None:
    residual = torch.full((1, 2, 2, 2), 0.3)
    assert float(median_length(torch.zeros(1, 2, 2, 3), residual)) == 0
    weight = torch.ones(1, 2, 2, 2)
    weight[0, 0] = float("nan")
    residual[0, 1, 1] = float("inf")
    length = float(median_length(weight, residual))
    assert length == pytest.approx(0.3 * 2**0.5, rel=0.012)


def test_edges_of_a_group_are_judged_together_and_apart_from_others() -> None:
    draw = torch.Generator().manual_seed(3)
    residual = (
        torch.randn(4, 6, 7, 2, generator=draw)
        * torch.tensor([1e-3, 1, 1e-3, 30])[:, None, None, None]
    )
    weight = torch.rand(4, 6, 7, 2, generator=draw)
    group = torch.tensor([0, 1, 0, 3])
    found = median_length(weight, residual, group, groups=4)
    alone = [median_length(weight[group == n], residual[group == n])[0] for n in range(4)]
    assert torch.equal(found, torch.stack(alone))
    assert found[2] == 0
