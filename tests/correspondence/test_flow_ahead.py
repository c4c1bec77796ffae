"""The motion filter runs ahead in a thread; what edges find may not depend on how far."""

from __future__ import annotations

import numpy as np
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
