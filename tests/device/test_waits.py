"""How often the host waits for a GPU where it must not: exact numbers, so that none creeps in."""

from __future__ import annotations

from collections import Counter

import pytest

from droidw.slam.frontend import Frontend
from droidw.slam.motion_filter import MotionFilter
from droidw.slam.optimise import Optimiser
from droidw.slam.system import SlamSystem
from droidw.testing.pretend_gpu import PretendGpu
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

FLOW = ("frontend.unknown_moves=1", "--preset", "cpu", "ba=torch", "frontend.predict=velocity")
DROID = ("--preset", "droid-slam", "ba=torch", "uncertainty=affine-softplus", "features=fit3d",
         "schedule.window.learn=true", "schedule.window_kept.learn=true")  # fmt: skip
WATCHED = {
    "measure": (Optimiser, "measure"),
    "step": (TorchBundleAdjuster, "step"),
    "learn": (Optimiser, "_learn"),
    "judge": (MotionFilter, "judge"),
    "append": (SlamSystem, "_append"),
    "window": (Frontend, "_window"),
}
"""What is counted, by the method that is called."""


@pytest.fixture
def watch(go, monkeypatch):
    """Waits of each call of each method of `WATCHED`, in order: `watch(*arguments)`."""

    def call(*arguments):
        counts = {name: [] for name in WATCHED}
        with PretendGpu() as gpu:
            for name, (owner, method) in WATCHED.items():
                monkeypatch.setattr(
                    owner, method, counted(gpu, getattr(owner, method), counts[name])
                )
            code, wrong, _ = go("cuda", *arguments)
        assert code == 0, wrong
        return counts, gpu

    def counted(gpu, method, found):
        def called(*args, **kwargs):
            before = gpu.total()
            result = method(*args, **kwargs)
            found.append(gpu.total() - before)
            return result

        return called

    return call


@pytest.mark.parametrize("arguments", [FLOW, DROID], ids=["flow", "droid"])
def test_waits_of_the_inner_loop(watch, arguments):
    counts, gpu = watch(*arguments)
    told = gpu.waits_by_line()
    # What a step must know: which poses move and whether sums are finite; and what came of it.
    assert set(counts["step"]) == {2}, told
    # One look at the energy, and whether the parameters are finite; in the last passes of global
    # adjustment, which presets of published systems do not learn in, also how uncertainty parts.
    assert set(counts["learn"]) == ({1, 2} if arguments is FLOW else {1}), told
    # Flow is searched on the host, from what geometry predicts: coordinates, which of them are
    # valid, and the gates of uncertainty.
    most = 3 if arguments is FLOW else 0
    assert max(counts["measure"]) == most, told
    # The mean flow decides whether a frame becomes a keyframe.
    assert set(counts["judge"]) == {0 if arguments is FLOW else 1} | {0}, told
    updates = 2  # of a keyframe that stays: one before, one after it is decided
    # Distances to propose edges from, the distance of the newest, and two steps of each update.
    budget = 2 + updates * (most + 2 * (2 + 1))
    assert max(counts["window"]) <= budget, told
    assert len(counts["window"]) > 1, "no window was run"


def test_a_depth_prior_costs_a_keyframe_nothing(watch):
    small = "depth={name: metric3d, options: {variant: vit-small, size: [56, 84]}}"
    counts, gpu = watch(*DROID, small)
    assert set(counts["append"][1:]) == {0}, gpu.waits_by_line()


def test_calibrated_similarities_cost_one_more(watch):
    counts, gpu = watch(*DROID, "weighting.similarity=matched")
    assert set(counts["learn"]) <= {1, 2} and 2 in counts["learn"], gpu.waits_by_line()


def test_a_new_keyframe_waits_for_nothing_that_is_not_new(watch):
    """Calibrations and positions are made once, from the first picture."""
    counts, gpu = watch(*DROID)
    assert set(counts["append"][1:]) == {0}, gpu.waits_by_line()
    lines = Counter({at: n for (_, at), n in gpu.waits.items() if "timing" in at})
    assert not lines, "stages are timed without waiting"
