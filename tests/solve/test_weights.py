"""The gate's published table, and what reaches bundle adjustment as a weight."""

from __future__ import annotations

import math

import pytest
import torch

from droidw.solve.weights import gate, half_open, opened, parting, residual_weights, unmasked


def test_rational_gate_matches_the_published_table() -> None:
    # REFERENCE 3.1, given there to two or three digits
    u = torch.tensor([0.0, 0.3, 0.8, 0.82, 0.85, 0.9, 1.0, 1.3, 1.77], dtype=torch.float64)
    expected = torch.tensor([1, 1, 1, 0.53, 0.31, 0.18, 0.10, 0.043, 0.022], dtype=torch.float64)
    assert torch.allclose(gate(u), expected, atol=6e-3)


def test_gate_falls_and_stays_in_range() -> None:
    u = torch.linspace(0, 20, 500)
    for kind in ("rational", "inverse", "none"):
        g = gate(u, kind)  # type: ignore[arg-type]
        assert float(g.min()) >= 0.0
        assert float(g.max()) <= 1.0
        assert bool((g[1:] <= g[:-1]).all())
        assert float(g[0]) == 1.0


def test_inverse_gate_is_one_over_u_above_one() -> None:
    assert gate(torch.tensor([0.5, 1.0, 2.0, 4.0]), "inverse").tolist() == [1.0, 1.0, 0.5, 0.25]


def test_gate_of_nonsense_is_zero_and_bad_arguments_are_refused() -> None:
    nan = torch.tensor([float("nan"), float("inf"), 0.1])
    assert gate(nan).tolist() == [0.0, 0.0, 1.0]
    assert gate(nan, "inverse").tolist() == [0.0, 0.0, 1.0]
    with pytest.raises(ValueError, match="rational, inverse, none"):
        gate(nan, "linear")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="positive"):
        gate(nan, floor=0.0)


@pytest.mark.parametrize("kind", ["rational", "inverse"])
def test_a_share_of_each_picture_keeps_its_whole_weight(kind) -> None:
    generator = torch.Generator().manual_seed(1)
    closed = 2.0 + torch.rand(6, 10, generator=generator)
    half = torch.where(torch.arange(10) < 6, 0.3, 1.5).expand(6, 10)
    left = opened(torch.stack([closed, half]), 0.5, kind)
    # the least uncertain half, and no more of it than the rest is worth
    weights = gate(left[0], kind)
    assert int((weights > 0.999).sum()) == 30
    assert bool((weights[closed > closed.median()] < 0.999).all())
    assert torch.equal(left[0].flatten().argsort(), closed.flatten().argsort())
    assert torch.equal(left[1], half)


def test_no_share_or_no_number_opens_nothing() -> None:
    u = torch.full((1, 2, 3), 5.0)
    assert torch.equal(opened(u, 0.0), u)
    assert torch.equal(opened(u, 0.5, "none"), u)
    assert opened(u[:0], 0.5).shape == (0, 2, 3)
    mixed = torch.tensor([[[float("nan"), float("inf"), 2.0], [4.0, float("nan"), 8.0]]])
    assert torch.equal(gate(opened(mixed, 0.5)) > 0.999, mixed <= 8.0)
    none = torch.full((1, 2, 3), float("nan"))
    assert gate(opened(none, 0.5)).eq(0).all()


def _edges() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    confidence = torch.rand(3, 4, 5, 2, generator=generator)
    gates = torch.rand(3, 4, 5, generator=generator)
    return confidence, gates, torch.tensor([0, 1, 2]), torch.tensor([1, 2, 0])


def test_a_gate_scales_the_whole_information() -> None:
    confidence, gates, ii, jj = _edges()
    full = torch.cat([confidence, -0.5 * confidence.prod(-1, keepdim=True).sqrt()], dim=-1)
    target = torch.full((3, 4, 5, 2), 1.5)
    weight = residual_weights(full, None, gates, ii, jj, target, bidirectional=True, scale=0.1)
    plain = residual_weights(confidence, None, gates, ii, jj, target, bidirectional=True, scale=0.1)
    assert torch.equal(weight[..., :2], plain)
    assert torch.allclose(weight[..., 2], -0.5 * plain.prod(-1).sqrt())


def test_weights_multiply_scale_gate_of_the_source_and_validity() -> None:
    confidence, gates, ii, jj = _edges()
    valid = torch.zeros(3, 4, 5, dtype=torch.bool)
    valid[:, 1:3] = True
    target = torch.zeros(3, 4, 5, 2)
    weight = residual_weights(confidence, valid, gates, ii, jj, target, scale=0.001)
    assert torch.allclose(weight, 0.001 * confidence * (gates[ii] * valid)[..., None])
    plain = residual_weights(confidence, None, None, ii, jj, target)
    assert torch.equal(plain, confidence)
    assert plain is not confidence


def test_bidirectional_gate_is_sampled_at_the_target_and_one_outside() -> None:
    confidence, gates, ii, jj = _edges()
    target = torch.full((3, 4, 5, 2), 1.0)
    target[..., 0] = 2.5  # between columns 2 and 3 of row 1
    target[:, 0, 0] = torch.tensor([-0.1, 1.0])
    target[:, 0, 1] = float("nan")
    weight = residual_weights(confidence, None, gates, ii, jj, target, bidirectional=True)
    between = 0.5 * (gates[jj, 1, 2] + gates[jj, 1, 3])
    factor = gates[ii] * between[:, None, None]
    factor[:, 0, :2] = gates[ii][:, 0, :2]
    assert torch.allclose(weight, confidence * factor[..., None], atol=1e-6)


def test_one_row_of_cells_can_be_sampled() -> None:
    gates = torch.full((2, 1, 1), 0.5)
    confidence = torch.ones(1, 1, 1, 2)
    weight = residual_weights(
        confidence,
        None,
        gates,
        torch.tensor([0]),
        torch.tensor([1]),
        torch.zeros(1, 1, 1, 2),
        bidirectional=True,
    )
    assert weight.flatten().tolist() == [0.25, 0.25]


def test_a_user_mask_reaches_the_cells_around_what_it_covers() -> None:
    covered = torch.zeros(5, 6)
    covered[0, 1], covered[3, 4] = 1.0, 0.25
    expected = torch.ones(5, 6)
    expected[:2, :3] = 0.0
    expected[2:, 3:] = 0.75
    assert torch.equal(unmasked(covered), expected)


def test_uncertainties_part_where_few_of_them_are():
    g = torch.Generator().manual_seed(0)
    stands = 0.6 * torch.exp(0.3 * torch.randn(900, generator=g))
    moves = 3.0 * torch.exp(0.2 * torch.randn(100, generator=g))
    u = torch.cat((stands, moves)).reshape(4, 10, 25)
    t = parting(u)
    assert (stands > t).float().mean() < 0.02
    assert (moves < t).float().mean() < 0.02
    bad = torch.cat((u.flatten(), torch.tensor([math.nan, math.inf, 0.0])))
    assert parting(bad) == pytest.approx(t, rel=0.05)


def test_a_few_that_are_far_off_do_not_part_the_others():
    """By variance between parts alone the limit would be at 1.2, within what stands still."""
    g = torch.Generator().manual_seed(0)
    stands = 0.6 * torch.exp(0.4 * torch.randn(950, generator=g))
    moves = 3.5 * torch.exp(0.1 * torch.randn(50, generator=g))
    assert 1.6 < parting(torch.cat((stands, moves))) < 2.9


def test_an_empty_stretch_is_parted_in_its_middle():
    assert parting(torch.tensor([0.5] * 6 + [2.0] * 2)) == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("u", [torch.empty(0), torch.full((3, 4), 0.7), torch.zeros(5)])
def test_what_is_alike_does_not_part(u):
    assert parting(u) == 0.0


@pytest.mark.parametrize("kind", ["rational", "inverse"])
def test_what_would_keep_less_keeps_nothing(kind):
    u = torch.linspace(0.0, 5.0, 101)
    as_it_says = gate(u, kind)
    shut = gate(u, kind, closed_below=0.5)
    assert (as_it_says > 0).all()
    assert torch.equal(shut, torch.where(as_it_says < 0.5, 0.0, as_it_says))
    assert gate(torch.tensor([2.0]), "inverse", closed_below=0.5).tolist() == [0.5]  # and no less


@pytest.mark.parametrize("kind", ["rational", "inverse"])
def test_half_of_the_gate(kind):
    assert gate(torch.tensor(half_open(kind)), kind).item() == pytest.approx(0.5, abs=1e-5)
    assert half_open("none") == math.inf
