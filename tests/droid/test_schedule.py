"""What the core does under the presets `paper` and `droid-slam`, update by update.

Correspondence is exact here and its calls are counted, so that the numbers of the published
schedule (REFERENCE 4.4, 5) can be read off without a network.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import torch

from droidw.config.load import load_config
from droidw.config.schema import MotionFilterConfig
from droidw.events import Dispatcher, KeyframeRemoved
from droidw.interfaces.correspondence import Motion
from droidw.slam.backend import Backend
from droidw.slam.frame import Frame
from droidw.slam.motion_filter import Encoded, MotionFilter


def updates(log, purpose):
    """Updates per session of this purpose, in order."""
    return list(Counter(name for kind, name, _ in log if kind == purpose).values())


def test_paper_initialises_in_three_phases(system_of):
    system, counted, frames = system_of("paper", "motion_filter.force_every=0")
    for frame in frames[:11]:
        system.push(frame)
    assert counted.log == [] and not system.frontend.initialised
    system.push(frames[11])
    assert system.frontend.initialised and len(counted.log) == 24
    edges = [set(e) for _, _, e in counted.log]
    near = {(i, j) for i in range(12) for j in range(12) if 1 <= abs(i - j) <= 3}
    assert all(e == near for e in edges[:8])
    assert all(e >= near and e == edges[8] for e in edges[8:16])
    # then what starts before the ninth keyframe is retired, and the rest goes on alone
    assert all({i for i, _ in e} <= set(range(8, 12)) for e in edges[16:])
    assert edges[16] == {(i, j) for i, j in edges[15] if i >= 8}
    graph = system.frontend.graph
    assert {graph.ii[r] for r in graph.select()} == {8, 9, 10, 11}
    # ages of what went through all three phases: 24 less the last 8
    assert {graph.age[r] for r in graph.select() if (graph.ii[r], graph.jj[r]) in near} == {16}


def test_paper_updates_three_times_and_twice_more_if_kept(system_of):
    system, counted, frames = system_of("paper", "frontend.keyframe_threshold=0")
    for frame in frames[:15]:
        system.push(frame)
    assert len(system.store) == 15
    assert updates(counted.log, "window") == [24 + 3 * 5]


def test_paper_drops_the_newest_five_times_at_most(system_of):
    system, counted, frames = system_of(
        "paper", "frontend.keyframe_threshold=1000", "motion_filter.force_every=0"
    )
    kept = [system.push(frame) for frame in frames[:24]]
    after = kept[12:]
    assert after == [False] * 5 + [True] + [False] * 5 + [True]
    assert updates(counted.log, "window") == [24 + 10 * 3 + 2 * 5]


def test_a_forced_keyframe_stays(system_of):
    system, _, frames = system_of(
        "paper", "frontend.keyframe_threshold=1000", "motion_filter.force_every=2"
    )
    kept = [system.push(frame) for frame in frames[:20]]
    # counted from the last keyframe that stayed, not from the last candidate
    assert kept[12:] == [False, True] * 4


def test_paper_ends_with_two_global_passes_and_twelve_updates_of_every_batch(system_of):
    system, counted, frames = system_of(
        "paper", "motion_filter.threshold=1000", "motion_filter.force_every=5"
    )
    for frame in frames:
        system.push(frame)
    outcome = system.finish(lambda: frames)
    assert len(system.store) == 6
    assert updates(counted.log, "global") == [7, 12]
    assert updates(counted.log, "fill") == [12, 12]
    batches = [{j for _, j in e} for kind, _, e in counted.log if kind == "fill"]
    assert [len(batches[0]), len(batches[-1])] == [16, 8]
    assert len(outcome.trajectory) == 30 and np.isfinite(outcome.trajectory.T_wc).all()
    edges = [e for kind, _, e in counted.log if kind == "global"]
    assert all(len(e) <= 6 * 6 + 2 for e in edges)
    # radius 1 links two predecessors
    assert {(i, j) for i in range(6) for j in (i - 1, i - 2) if j >= 0} <= set(edges[0])


def test_paper_frames_after_the_last_keyframe_start_from_it(system_of):
    system, counted, frames = system_of(
        "paper", "motion_filter.threshold=1000", "motion_filter.force_every=8"
    )
    for frame in frames:
        system.push(frame)
    system.finish(lambda: frames)
    last = [e for kind, _, e in counted.log if kind == "fill"][-1]
    sources = Counter(j for _, j in last)
    # frames 25 to 29 lie after the last keyframe, 24: one edge each; the others have two
    assert sorted(sources.values())[:5] == [1] * 5


def test_the_next_keyframe_starts_from_the_last_pose_and_a_plane(system_of):
    system, _, frames = system_of("paper", "frontend.keyframe_threshold=0")
    for frame in frames[:12]:
        system.push(frame)
    store = system.store
    store.T_cw[11, :3] = torch.tensor([0.1, 0.2, 0.3])
    store.disps[8:12] = torch.tensor([1.0, 2.0, 3.0, 6.0])[:, None, None]
    pose, disp = system.frontend.guess(1.0)
    assert torch.equal(pose, store.T_cw[11])
    assert torch.allclose(disp, torch.tensor(3.0)) and disp.shape == (8, 12)
    system.push(frames[12])
    store.disps[12] = torch.linspace(1, 2, 96).view(8, 12)
    pose, disp = system.frontend.guess(1.0)
    assert torch.equal(pose, store.T_cw[12])
    assert torch.allclose(disp, torch.tensor(1.5))


def test_droid_slam_starts_from_half_of_the_last_motion(system_of):
    system, _, frames = system_of("droid-slam", "frontend.keyframe_threshold=0")
    for frame in frames[:8]:
        system.push(frame)
    store = system.store
    store.T_cw[6, :3] = torch.tensor([0.1, 0.0, 0.3])
    store.T_cw[7, :3] = torch.tensor([0.2, 0.1, 0.2])
    store.disps[5:8] *= torch.tensor([0.5, 2.0, 3.0])[:, None, None]
    pose, disp = system.frontend.guess(1.0)
    step = store.T_cw[7, :3] - store.T_cw[6, :3]
    assert torch.allclose(pose[:3] - store.T_cw[7, :3], 0.5 * step, atol=1e-6)
    assert torch.allclose(disp, torch.tensor(2.0))


def test_droid_slam_initialises_in_two_phases_with_eight_keyframes(system_of):
    system, counted, frames = system_of("droid-slam", "frontend.keyframe_threshold=0")
    for frame in frames[:10]:
        system.push(frame)
    assert updates(counted.log, "window") == [16 + 2 * 5]


def test_droid_slam_drops_the_last_but_two(system_of):
    removed = []

    class Hears:
        def on_event(self, event):
            if isinstance(event, KeyframeRemoved):
                removed.append((event.keyframe, event.index))

    system, counted, frames = system_of(
        "droid-slam", "frontend.keyframe_threshold=1000", events=Dispatcher([("hears", Hears())])
    )
    kept = [system.push(frame) for frame in frames[:11]]
    assert all(kept)  # the newest is never the one that goes
    assert removed == [(6, 6), (6, 7), (6, 8)]
    assert [info.index for info in system.store.infos] == [0, 1, 2, 3, 4, 5, 9, 10]
    graph = system.frontend.graph
    assert max(graph.ii) == 7 and len(set(graph.pairs)) == len(graph.pairs)
    assert updates(counted.log, "window") == [16 + 3 * 3]


def test_droid_slam_brings_the_mean_disparity_to_one(system_of):
    system, _, frames = system_of(
        "droid-slam", "backend.passes=[1]", "frontend.keyframe_threshold=0"
    )
    for frame in frames[:9]:
        system.push(frame)
    store = system.store
    store.disps.copy_(torch.rand(9, 8, 12) + 2.0)
    store.T_cw[:, :3] = torch.rand(9, 3)
    disps, T_cw, mean = store.disps.clone(), store.T_cw.clone(), store.disps.mean()
    backend = Backend(system.optimiser, system.config)
    assert backend.run(lambda done, total: None) > 0
    assert torch.allclose(store.disps, disps / mean)
    assert torch.allclose(store.T_cw[:, :3], T_cw[:, :3] * mean)
    # a depth prior has a scale of its own
    store["prior"].fill_(0.7)
    store.write(T_cw, disps)
    backend.run(lambda done, total: None)
    assert torch.equal(store.disps, disps)


def test_droid_slam_thins_its_global_edges_as_the_window_does(system_of):
    few, many = (
        system_of("droid-slam", f"backend.nms_shape={shape}", "backend.nms=5",
                  "frontend.keyframe_threshold=0", "backend.passes=[1]")
        for shape in ("square", "diamond")
    )  # fmt: skip
    counts = []
    for system, counted, frames in (few, many):
        for frame in frames[:14]:
            system.push(frame)
        Backend(system.optimiser, system.config).run(lambda done, total: None)
        counts.append(len(next(e for kind, _, e in counted.log if kind == "global")))
    assert counts[0] < counts[1] <= 16 * 14 + 2


def test_the_window_is_released_before_the_end(system_of):
    system, counted, frames = system_of("paper", "frontend.keyframe_threshold=0")
    for frame in frames[:14]:
        system.push(frame)
    session = system.frontend.session
    system.finish(lambda: frames)
    assert session.known == set()
    assert [node for node, _ in counted.enlarged] == list(range(14))


def test_maps_are_enlarged_after_the_last_step_and_reach_the_records(system_of):
    system, counted, frames = system_of("paper", "frontend.keyframe_threshold=0")
    for frame in frames[:13]:
        system.push(frame)
    outcome = system.finish(lambda: frames)
    assert all(torch.equal(d, system.store.disps[n]) for n, d in counted.enlarged)
    record = outcome.keyframes[4]
    assert record.disp_full.shape == (64, 96) and record.disp_full.dtype == np.float32
    assert np.array_equal(record.disp_full[::8, ::8], record.disp)


class Still:
    """Correspondence whose motion is a table."""

    def __init__(self, flows):
        self.flows = flows

    def motion(self, reference, current):
        return Motion(self.flows[current], 1.0)


def test_frames_are_counted_from_the_last_keyframe_that_stayed():
    """REFERENCE 5.1: a candidate that is dropped again does not start the count anew."""
    config = load_config(preset="paper").data["motion_filter"]
    flows = [0.0] * 12
    flows[5] = 4.0
    judge = MotionFilter(Still(flows), MotionFilterConfig(**config))
    blank = torch.zeros(0)
    verdicts = []
    for k in range(12):
        verdicts.append(judge.judge(Encoded(Frame(k, k / 30, blank, blank), k)))
        if verdicts[-1].keep:
            judge.settled(k, kept=k != 5)
    assert [k for k, v in enumerate(verdicts) if v.keep] == [0, 5, 9]
    assert [k for k, v in enumerate(verdicts) if v.forced] == [9]
