"""What the motion filter finds, ahead in a thread, is kept for edges of the same pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid

H, W = 120, 160


def moving(k):
    """Grey levels [H,W] of a picture of blobs that moves by 6 pixels a frame."""
    y, x = np.mgrid[:H, :W].astype(np.float32)
    x = x - 6 * k
    waves = np.sin(x / 5 + y / 9) + np.sin(x / 11 - y / 6) + np.sin(x / 17 + y / 13)
    return (128 + 35 * waves).astype(np.float32)


def test_an_edge_does_not_depend_on_how_far_ahead_the_filter_is(operator, frame, question):
    frames = [frame(k, moving(k % 5)) for k in range(80)]

    def target(watched):
        """Target of the edge 0 -> 2 after the filter has seen the first `watched` frames."""
        part = operator()
        grid = Grid.of(H, W, part.stride, part.offset)
        seen = [part.encode(f, grid) for f in frames[:watched]]
        for k in range(1, watched):
            part.motion(seen[0 if k <= 2 else 2], seen[k])
            if k == 2:
                part.context(seen[2], frames[2], grid)
        return part.session().update(question(part, [frames[0], frames[2]])).target

    assert torch.equal(target(3), target(80))
    # the filter's search starts from the motion so far: this would be seen
    assert not torch.equal(target(3), target(0))


def test_what_it_finds_under_a_mask_is_not_taken_for_the_whole_picture(operator, frame):
    """A frame is encoded twice where it is tracked without what was found to move."""
    mask = np.zeros((H, W), bool)
    mask[:, 40:120] = True
    part = operator()
    grid = Grid.of(H, W, part.stride, part.offset)

    def encoded(*masks):
        frames = [frame(k, moving(k), masks[k]) for k in range(2)]
        return [part.encode(f, grid) for f in frames], frames[1]

    (plain, last), (hidden, _) = encoded(None, None), encoded(mask, mask)
    fresh = operator().one_way(*plain)
    part.motion(*hidden)
    part.context(hidden[1], last, grid)
    assert np.array_equal(part.one_way(*plain).target, fresh.target)
    whole = part.both_ways(*plain, None, None, bridged=tuple(plain))
    cut = part.both_ways(*hidden, None, None, bridged=tuple(hidden))
    assert not np.array_equal(whole[0].target, cut[0].target)
    again = operator().both_ways(*plain, None, None, bridged=tuple(plain))
    assert np.array_equal(whole[0].target, again[0].target)


@pytest.mark.parametrize("step", [4, 8])
def test_frames_that_are_not_read_are_not_missing(operator, frame, step):
    """With `--stride` a picture is searched from the motion so far, too."""

    def found(step, gap=0):
        part = operator()
        grid = Grid.of(H, W, part.stride, part.offset)
        indices = [0, step, 2 * step + gap, 3 * step + gap]
        seen = [part.encode(frame(index, moving(k)), grid) for k, index in enumerate(indices)]
        motions = [part.motion(seen[0], one) for one in seen[1:]]
        return motions, part.one_way(seen[0], seen[3]).target

    motions, target = found(step)
    expected, same = found(1)
    assert motions == expected and np.array_equal(target, same)
    # more of them in a row than may be missing: the last of the searches starts afresh
    assert found(step, gap=6 * step)[0] != expected
