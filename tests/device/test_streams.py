"""Work on frames to come has a stream of its own, and nothing is read or given up too early."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from droidw.slam import cell_maps
from droidw.slam.streams import Ahead, tensors_in
from droidw.testing.pretend_gpu import PretendGpu

MOVING = ("motion_filter.threshold=0.3", "motion_filter.force_every=0", "ba=torch")
FLOW = (
    "--preset",
    "cpu",
    "features={name: fit3d, options: {precision: float32}}",
    "depth={name: metric3d, options: {variant: vit-small, size: [56, 84], precision: float32}}",
    # each step lets the rounding of a path without parallax grow, and a second look has many
    "schedule.global.iterations=4",
    "backend.backwards_below=0",
    # nor do its depths, let go
    "global_solver.depth_damping=1",
    # softened, or with their border at a quarter, its pictures hold a path even less
    "correspondence.options.blur=0",
    "correspondence.options.border=0",
    # and whether exposure has changed by half of a hundredth is a matter of rounding
    "correspondence.options.exposure=false",
    # nor do second differences of such depths hold a path
    "correspondence.options.curved=false",
)
DROID = ("--preset", "droid-slam", "correspondence.options={precision: float32, store: float}",
         "uncertainty=affine-softplus", "features=fit3d", "frontend.predict=velocity")  # fmt: skip
RUNS = {"flow": FLOW, "droid": DROID}


@dataclass(frozen=True)
class Payload:
    index: int
    fmap: torch.Tensor


def test_tensors_are_found_wherever_they_are():
    a, b, c, d = (torch.full((1,), float(k)) for k in range(4))
    held = [Payload(0, a), {"x": (b, None)}, "text", 3, ({"y": [c]},), d]
    assert [float(t) for t in tensors_in(held)] == [0, 1, 2, 3]


@pytest.mark.parametrize(("device", "threaded"), [("cpu", True), ("cpu", False), ("cuda", False)])
def test_without_a_thread_on_a_gpu_nothing_is_done(device, threaded):
    ahead = Ahead(torch.device(device), threaded)
    with ahead.working():
        made = torch.ones(2)
    assert ahead.stream is None and ahead.ready() is None
    ahead.take(ahead.ready(), made)


@pytest.fixture
def ahead_run(go):
    """A run with a thread that looks ahead; `QUICK` forces keyframes, which rules that out."""

    def call(name):
        with PretendGpu() as gpu:
            code, wrong, centres = go("cuda", *RUNS[name], after=MOVING)
        return code, wrong, centres, gpu

    return call


@pytest.mark.parametrize("name", RUNS)
def test_the_stream_is_used_and_in_order(go, ahead_run, monkeypatch, name):
    # made-up depths are spread so far that some lie at the limit, on either side by rounding
    monkeypatch.setattr(cell_maps, "_NO_DEPTH", 0.0)
    code, wrong, cpu = go("cpu", *RUNS[name], after=MOVING)
    assert code == 0, wrong
    code, wrong, there, gpu = ahead_run(name)
    assert code == 0, wrong
    used = gpu.streams.used_by
    assert len(used) == 2 and min(used.values()) > 100, used
    assert gpu.streams.faults == []
    assert not [at for what, at in gpu.waits if "not pinned" in what]
    # made-up depth leaves `flow` next to no parallax: rounding of the last place grows to 1 % there
    share = 2e-2 if name == "flow" else 2e-3
    np.testing.assert_allclose(there, cpu, atol=share * np.ptp(cpu, axis=0).max())


def test_a_second_look_reads_nothing_too_early(go):
    with PretendGpu() as gpu:
        code, wrong, _ = go("cuda", *FLOW, after=(*MOVING, "backend.backwards_below=1"))
    assert code == 0, wrong
    assert gpu.streams.faults == []


@pytest.mark.parametrize(("broken", "said"), [
    ("wait", "may not have finished"), ("record", "record_stream is missing"),
])  # fmt: skip
def test_what_is_left_out_is_found(ahead_run, monkeypatch, broken, said):
    """That the check above can fail."""

    def without_wait(self, ready, *made):
        return None

    def without_record(self, ready, *made):
        torch.cuda.current_stream().wait_event(ready)

    monkeypatch.setattr(Ahead, "take", without_wait if broken == "wait" else without_record)
    *_, gpu = ahead_run("droid")
    assert any(said in fault for fault in gpu.streams.faults), gpu.streams.faults
