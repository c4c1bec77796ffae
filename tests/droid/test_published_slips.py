"""Slips of the published code (REFERENCE 10) that `compat: [droid-w]` brings back, and only it.

The others of correspondence (first keyframe, border of enlarged maps) are in test_droid.py and
test_update.py.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.graph.factors import FactorGraph
from droidw.graph.store import KeyframeInfo, KeyframeStore
from droidw.interfaces.depth import DepthMap
from droidw.slam.cloud import consistent_depth


def test_retirement_rule_of_the_published_code():
    """The example of REFERENCE 11: cap 8, two to be added."""
    ages = [0, 5, 2, 7, 1, 9, 3, 0, 4, 6]
    graph = FactorGraph(2, 2)
    graph.add((k, k + 1) for k in range(len(ages)))
    graph.age = list(ages)
    assert [ages[row] for row in graph.oldest_as_published(8 - 2)] == [5, 1, 9, 0]
    assert [ages[row] for row in graph.oldest(8 - 2)] == [9, 7, 6, 5]


def test_retirement_rule_is_the_right_one_for_edges_stored_by_age():
    graph = FactorGraph(2, 2)
    graph.add((k, k + 1) for k in range(6))
    graph.retire([1])
    graph.age = [5, 9, 4, 3, 2, 1]
    # stored oldest first: rank k from the youngest end mirrors the place in storage
    assert sorted(graph.oldest_as_published(3)) == sorted(graph.oldest(3))


def test_which_edges_the_window_keeps(system_of):
    kept = []
    for compat in ("[]", "[droid-w]"):
        system, counted, frames = system_of(
            "paper", "frontend.keyframe_threshold=0", "frontend.max_factors=40", f"compat={compat}"
        )
        for frame in frames[:14]:
            system.push(frame)
        window = [e for _, _, e in counted.log[24:]]
        assert all(0 < len(e) <= 40 for e in window)
        newest = [e for e in window if any(13 in pair for pair in e)]
        assert len(newest) == 5
        kept.append({pair for pair in newest[0] if max(pair) < 13})
    assert kept[0] != kept[1]


def two_by_two(count, disps):
    """Keyframes at one place with these disparities, as a store."""
    store = KeyframeStore(Grid(4, 4, 8, 0.0), torch.tensor([30.0, 30.0, 16.0, 16.0]))
    identity = torch.tensor([0.0, 0, 0, 0, 0, 0, 1])
    for k in range(count):
        store.append(
            KeyframeInfo(k, float(k), "", None, None),
            T_cw=identity, disps=torch.full((4, 4), disps[k]),
        )  # fmt: skip
    return store


def test_depth_is_compared_with_the_next_keyframes_too():
    """REFERENCE 5.9: the published code leaves out +1 and +2 and looks at +3, +4, +5."""
    # keyframe 0 agrees with 1 and 2 alone, keyframe 3 with 0 to 2 not and with 6 to 8
    store = two_by_two(9, [1.0, 1.0, 1.0, 2.0, 5.0, 7.0, 2.0, 2.0, 2.0])
    right = consistent_depth(store, 0.01, 2, 1e-5)[:, 0, 0].tolist()
    published = consistent_depth(store, 0.01, 2, 1e-5, published=True)[:, 0, 0].tolist()
    assert right == [True, True, True, False, False, False, True, True, True]
    assert published == [False, False, True, True, False, False, False, False, True]


@pytest.mark.parametrize("compat", ["[]", "[droid-w]"])
def test_maps_are_enlarged_before_or_after_the_last_adjustment(system_of, compat):
    """REFERENCE 5.7: the published code enlarges the disparities of before the step."""
    system, counted, frames = system_of(
        "paper", "frontend.keyframe_threshold=0", f"compat={compat}"
    )
    for frame in frames[:13]:
        system.push(frame)
    assert torch.equal(system.store.disps, torch.ones_like(system.store.disps))
    system.parts.ba.factor = 1.1
    system.finish(lambda: frames)
    steps = 2 * (7 + 12)
    # the last update step has two iterations
    seen = steps - 2 if compat == "[droid-w]" else steps
    assert len(counted.enlarged) == 13
    for _, disp in counted.enlarged:
        assert torch.allclose(disp, torch.tensor(1.1**seen), rtol=1e-4)


@pytest.mark.parametrize(("compat", "pixel"), [("[]", 0), ("[droid-w]", 3)])
def test_where_depth_is_taken_from(system_of, compat, pixel):
    """REFERENCE 2.2, 2.4: rays through pixel 8 x, but depth and features of pixel 8 x + 3."""
    system, _, frames = system_of("paper", f"compat={compat}")
    ramp = torch.arange(1.0, 97.0).expand(64, 96)

    class Ramp:
        metric = False

        def predict(self, frame):
            return DepthMap(ramp)

    grids = []

    class Notes:
        dim = 0

        def extract(self, image, grid):
            grids.append(grid)
            return image.new_zeros(0, grid.height, grid.width)

    system._maps.parts = replace(system.parts, features=Notes(), depth=Ramp())
    system.push(frames[0])
    expected = 1 / (torch.arange(12.0) * 8 + 1 + pixel)
    assert torch.allclose(system.store["prior"][0], expected.expand(8, 12))
    assert grids[0].offset == pixel
    assert torch.equal(system.store.intrinsics, system.store.image_intrinsics / 8)
