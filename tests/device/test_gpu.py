"""On a true GPU (`pytest --device cuda`): the numbers of the CPU, streams that change nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from droidw.slam.streams import Ahead
from droidw.slam.system import SlamSystem

pytestmark = pytest.mark.gpu

FLOW = (
    "--preset",
    "cpu",
    "frontend.predict=velocity",
    # of a clip next to without parallax rounding decides what is kept, and where depths go
    "backend.backwards_below=0",
    "global_solver.depth_damping=1",
)
DROID = ("--preset", "droid-slam",
         "correspondence.options={precision: float32, store: float}")  # fmt: skip
SMALL = "depth={name: metric3d, options: {variant: vit-small, size: [56, 84], precision: float32}}"
RUNS = {
    "cnn, affine-softplus": FLOW,
    "dinov2, per-pixel": (
        *FLOW, "features={name: dinov2, options: {precision: float32}}", "uncertainty=per-pixel",
    ),
    "fit3d, mlp": (
        *FLOW, "features={name: fit3d, options: {precision: float32}}", "uncertainty=mlp",
    ),
    "metric3d, nothing else": (*FLOW, "features=none", "uncertainty=none", SMALL),
    "file": (*FLOW, "depth=file"),
    "droid": DROID,
    "droid, low memory": (
        *DROID[:-1],
        "correspondence.options={precision: float32, store: float, correlation: lowmem}",
    ),
}  # fmt: skip
# Sums in another order go through all of Gauss-Newton.
SHARE = 2e-2


@pytest.mark.parametrize("ba", ["torch", "auto"])
@pytest.mark.parametrize("name", RUNS)
def test_a_run_is_that_of_the_cpu(go, clip, name, ba):
    more = ["depth.options.path=" + str(clip / "depth")] if name == "file" else []
    found = []
    for device in ("cpu", "cuda"):
        code, wrong, centres = go(device, *RUNS[name], f"ba={ba}", *more)
        assert code == 0, wrong
        found.append(centres)
    cpu, there = found
    np.testing.assert_allclose(there, cpu, atol=SHARE * np.ptp(cpu, axis=0).max())


@pytest.fixture
def alone(monkeypatch):
    """Switch the thread that looks ahead off, from now on."""
    make = SlamSystem.__init__

    def unthreaded(self, *args, **kwargs):
        make(self, *args, **{**kwargs, "threaded": False})

    return lambda: monkeypatch.setattr(SlamSystem, "__init__", unthreaded)


@pytest.mark.parametrize("name", ["fit3d, mlp", "droid"])
def test_streams_do_not_change_results(go, alone, name):
    moving = ("motion_filter.threshold=0.3", "motion_filter.force_every=0")
    code, wrong, beside = go("cuda", *RUNS[name], after=moving)
    assert code == 0, wrong
    alone()
    code, wrong, after = go("cuda", *RUNS[name], after=moving)
    assert code == 0, wrong
    np.testing.assert_allclose(beside, after, atol=1e-3 * np.ptp(after, axis=0).max())


def test_the_preset_paper_in_half_precision(go):
    small = "depth.options={variant: vit-small, size: [56, 84]}"
    code, wrong, centres = go("cuda", "--preset", "paper", small)
    assert code == 0, wrong
    assert np.isfinite(centres).all()


def test_torch_finds_no_wait_where_the_pretended_gpu_found_none(go, alone, monkeypatch):
    """Appending a keyframe, with torch told to refuse waits."""
    alone()  # the other thread reads how far the picture moved
    append = SlamSystem._append

    def watched(self, current):
        if len(self.store) < 2:
            return append(self, current)
        torch.cuda.set_sync_debug_mode("error")
        try:
            return append(self, current)
        finally:
            torch.cuda.set_sync_debug_mode("default")

    monkeypatch.setattr(SlamSystem, "_append", watched)
    code, wrong, _ = go("cuda", *DROID, "ba=torch")
    assert code == 0, wrong


def test_the_stream_beside_tracking_is_another_one():
    ahead = Ahead(torch.device("cuda"), threaded=True)
    with ahead.working():
        made = torch.ones(1 << 20, device="cuda").cumsum(0)
        assert torch.cuda.current_stream() == ahead.stream
    ahead.take(ahead.ready(), made)
    assert torch.cuda.current_stream() != ahead.stream
    assert float(made[-1]) == 1 << 20
