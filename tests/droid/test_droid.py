"""The operator: pictures it takes, motion, precision, and the published slips."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.errors import ConfigError, InputError
from droidw.geometry.camera import Grid
from droidw.interfaces.correspondence import Correspondence, EdgeSession, Motion
from droidw.slam.frame import Frame
from droidw.testing.conformance import check
from droidw_plugins.correspondence._droid import DroidCorrespondence
from droidw_plugins.correspondence._droid_corr import Pyramid, lookup, volume
from droidw_plugins.correspondence.droid import COMPONENT, DroidOptions


def picture(height, width):
    return Frame(0, 0.0, torch.rand(3, height, width), torch.tensor([60.0, 60, 30, 30]))


def test_it_is_a_correspondence(operator):
    part = operator()
    assert isinstance(part, Correspondence)
    assert isinstance(part.session(), EdgeSession)
    assert (part.stride, part.offset) == (8, 0.0)


def test_the_grid_has_the_published_intrinsics_and_the_size_of_the_maps(operator):
    part = operator()
    for height, width in ((64, 96), (72, 64), (128, 160)):
        grid = Grid.of(height, width, part.stride, part.offset)
        assert (grid.height, grid.width) == (height // 8, width // 8)
        K = torch.tensor([500.0, 510.0, 255.0, 190.0])
        assert torch.equal(grid.intrinsics(K), K / 8)


@pytest.mark.parametrize(("height", "width"), [(100, 96), (64, 97), (203, 277)])
def test_sides_that_are_no_multiple_of_8(operator, height, width):
    with pytest.raises(InputError, match="multiples of 8") as caught:
        operator().encode(picture(height, width), Grid.of(height, width, 8, 0.0))
    assert f"{width}x{height}" in caught.value.message and "camera.size" in caught.value.hint


def test_the_size_that_is_offered_is_taken(operator):
    with pytest.raises(InputError) as caught:
        operator().encode(picture(70, 157), Grid.of(70, 157, 8, 0.0))
    assert "[160,72]" in caught.value.hint
    payload = operator().encode(picture(72, 160), Grid.of(72, 160, 8, 0.0))
    assert payload.fmap.shape == (128, 9, 20)


@pytest.mark.parametrize(("height", "width"), [(56, 96), (128, 48), (32, 32)])
def test_pictures_smaller_than_the_pyramid(operator, height, width):
    with pytest.raises(InputError, match="too small") as caught:
        operator().encode(picture(height, width), Grid.of(height, width, 8, 0.0))
    assert "64 px" in caught.value.hint


def test_motion_is_the_mean_correction_of_one_round(operator, frames, grid, net):
    part = operator()
    reference, current = part.encode(frames[0], grid), part.encode(frames[2], grid)
    keyframe = part.context(reference, frames[0], grid)
    found = part.motion(reference, current)
    pyramid = Pyramid(8, 12)
    cells = torch.stack(torch.meshgrid(torch.arange(12.0), torch.arange(8.0), indexing="xy"), -1)
    with torch.no_grad():
        pair = volume(keyframe.fmap, pyramid.features(current.fmap))
        corr = lookup([pair], cells[None], pyramid)
        delta = net.update(keyframe.net[None], keyframe.inp[None], corr).delta
    assert found.flow == pytest.approx(float(delta.norm(dim=-1).mean()), rel=1e-4)
    assert found.matched == 1.0
    # a second frame against the same reference, and the keyframe itself as the reference
    other = part.motion(reference, part.encode(frames[3], grid))
    assert other.flow != found.flow
    assert part.motion(keyframe, current).flow == pytest.approx(found.flow)


def test_what_a_mask_covers_does_not_tell_how_far_a_picture_moved(operator, frames, grid):
    part = operator()
    first, current = (part.encode(frames[k], grid) for k in (0, 2))
    reference = part.context(first, frames[0], grid)
    whole = part.motion(reference, current)
    mask = torch.zeros(64, 96, dtype=torch.bool)
    masked = replace(frames[2], mask=mask)
    assert part.motion(reference, part.encode(masked, grid)).flow == pytest.approx(whole.flow)
    mask[:, 48:] = True
    half = part.encode(masked, grid)
    assert torch.equal(half.fmap, current.fmap)
    assert half.seen is not None and not half.seen[:, 6:].any() and half.seen[:, :4].all()
    found = part.motion(reference, half)
    assert found.flow != whole.flow and found.matched == 1.0
    # the same from the other side, and of a keyframe
    covered = replace(frames[0], mask=mask)
    begun = part.context(part.encode(covered, grid), covered, grid)
    assert part.motion(begun, current).flow == pytest.approx(found.flow)
    mask[:] = True
    assert part.motion(reference, part.encode(masked, grid)) == Motion(0.0, 0.0)


def test_motion_from_a_frame_that_was_no_candidate(operator, frames, grid):
    part = operator()
    payloads = [part.encode(f, grid) for f in frames[:2]]
    with pytest.raises(ValueError, match="no context"):
        part.motion(*payloads)


def test_the_reference_stays_when_the_keyframe_is_dropped_again(operator, frames, grid):
    """REFERENCE 5.1: the comparison state does not hang on what the frontend does."""
    part = operator()
    payloads = [part.encode(f, grid) for f in frames[:2]]
    part.context(payloads[0], frames[0], grid)  # thrown away, as a dropped keyframe is
    assert part.motion(*payloads).flow > 0


def test_published_first_keyframe(operator, frames, grid):
    """REFERENCE 5.1: one channel of the first context stands for all, in the store alone."""
    right, published = operator(), operator(published=True)
    a, b = right.encode(frames[0], grid), published.encode(frames[0], grid)
    good, slip = right.context(a, frames[0], grid), published.context(b, frames[0], grid)
    for name in ("net", "inp"):
        all_channels, one_channel = getattr(good, name), getattr(slip, name)
        assert one_channel.shape == all_channels.shape
        assert torch.equal(one_channel, all_channels[:1].expand_as(all_channels))
        assert not torch.equal(one_channel, all_channels)
    other = right.encode(frames[1], grid)
    assert published.motion(b, other).flow == right.motion(a, other).flow
    # the second keyframe is as it should be
    c, d = right.encode(frames[2], grid), published.encode(frames[2], grid)
    assert torch.equal(
        right.context(c, frames[2], grid).net, published.context(d, frames[2], grid).net
    )


def test_half_precision_in_the_store(operator, encoded, ask):
    exact, half = operator(store="float"), operator(store="half")
    a, b = encoded(exact), encoded(half)
    assert b[0].fmap.dtype == b[0].net.dtype == b[0].inp.dtype == torch.float16
    expected = exact.session().update(ask(a, [(0, 1), (2, 1)]))
    session = half.session()
    found = session.update(ask(b, [(0, 1), (2, 1)]))
    assert session._edges[0].volume.dtype == session._edges[0].net.dtype == torch.float16
    assert found.target.dtype == found.damping.dtype == found.upmask.dtype == torch.float32
    error = (found.target - expected.target).norm(dim=-1).mean()
    moved = (expected.target - ask(a, [(0, 1), (2, 1)]).coords).norm(dim=-1).mean()
    assert float(error) < 5e-3 * float(moved)


def test_bfloat16_is_an_option(operator, encoded, ask):
    exact, rough = operator(), operator(precision="bfloat16")
    expected = exact.session().update(ask(encoded(exact), [(0, 1), (2, 1)]))
    found = rough.session().update(ask(encoded(rough), [(0, 1), (2, 1)]))
    assert found.target.dtype == found.confidence.dtype == torch.float32
    assert 0 < float((found.confidence - expected.confidence).abs().mean()) < 0.05


def test_float16_needs_a_gpu(net):
    with pytest.raises(ConfigError, match="float16"):
        DroidCorrespondence(net, DroidOptions(precision="float16"), torch.device("cpu"))


def test_the_contract_of_correspondence_but_for_accuracy(net):
    """All clauses before `accuracy` hold; rule-made weights cannot match pictures."""
    component = replace(
        COMPONENT,
        factory=lambda options, context: DroidCorrespondence(net, options, context.device),
    )
    with pytest.raises(AssertionError, match="accuracy") as caught:
        check("correspondence", component)
    assert "breaks clause 'accuracy'" in str(caught.value)


def test_numbers_are_the_same_twice(operator, encoded, ask):
    answers = []
    for _ in range(2):
        part = operator(store="half")
        answers.append(part.session().update(ask(encoded(part), [(0, 1), (1, 2), (2, 0)])))
    assert torch.equal(answers[0].target, answers[1].target)
    assert torch.equal(answers[0].damping, answers[1].damping)
