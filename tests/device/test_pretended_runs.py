"""Every built-in part in a run on a pretended GPU: the numbers of the CPU, no mix of devices."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import droidw
from droidw.slam.system import SlamSystem
from droidw.testing.pretend_gpu import PretendGpu
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

# One pass more, whether the path has come to rest or not: rounding may decide otherwise.
CPU = (
    "--preset", "cpu", "ba=torch", "frontend.predict=velocity",
    "backend.more_passes=1", "backend.at_rest=0",
)  # fmt: skip
# One search: a second one rests on cells that a threshold picks, and rounding picks others. Nor is
# there an exposure to take out, for up to half of a hundredth is none, nor is a picture resampled,
# for that is done at whole 32nds of a pixel, nor does flow bend by the depths of so few pictures.
FLOW = (*CPU, "correspondence.options={bridge: 0, exposure: false, warp: false, curved: false}")
DROID = (
    "--preset", "droid-slam", "ba=torch",
    "correspondence.options={precision: float32, store: float}",
)  # fmt: skip
SMALL = "depth.options={variant: vit-small, size: [56, 84], precision: float32}"
RUNS = {
    "the preset cpu with one search": (*FLOW,),
    "two searches": (*CPU,),
    "match, and residuals both ways": (
        *FLOW, "frontend.predict=match", "weighting.bidirectional=true",
    ),
    "several starts, and a focal length": (
        *FLOW, "frontend.starts=true", "camera.refine_focal=true", "input.max_frames=8",
    ),
    "keyframes from between": (
        *FLOW, "backend.between_hidden=0", "backend.restart_below=0", "backend.passes=[1, 1, 1, 1]",
    ),
    "no parts": (*FLOW, "features=none", "uncertainty=none"),
    "per-pixel": (*FLOW, "uncertainty=per-pixel"),
    "mlp": (*FLOW, "uncertainty=mlp"),
    "refresh and tolerance": (
        *FLOW, "uncertainty={name: affine-softplus, options: {tolerance: 0.05, refresh: 2, "
        "bulk: 0.3}}",
    ),
    "cnn without calibration": (*FLOW, "features.options.calibration=weights"),
    "dinov2": (*FLOW, "features={name: dinov2, options: {precision: float32}}"),
    "fit3d": (
        *FLOW,
        "features={name: fit3d, options: {precision: float32, calibration: picture, constant: 1}}",
    ),
    "metric3d": (*FLOW, "depth=metric3d", SMALL, "uncertainty=none", "features=none"),
    "file": (*FLOW, "depth=file"),
    "droid": (*DROID,),
    "droid, low memory": (
        *DROID[:-1],
        "correspondence.options={precision: float32, store: float, correlation: lowmem}",
    ),
    "a guarded step": (*FLOW, "solver.guard=true", "solver.huber=0"),
    "all that was published": (
        *DROID, "features={name: fit3d, options: {precision: float32}}", "compat=[droid-w]",
        "uncertainty=affine-softplus", "depth=metric3d", SMALL, "schedule.window.learn=true",
    ),
}  # fmt: skip


MORE = {
    "several starts, and a focal length", "cnn without calibration", "dinov2", "metric3d",
    "droid, low memory", "a guarded step",
}  # fmt: skip
"""Left to `--runslow`: they take long, or some other run has most of them."""

APART = {"two searches": 2e-2, "refresh and tolerance": 2e-2}
"""Share of the path by which centres may differ where a threshold picks, elsewhere 2e-3."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in MORE)) for name in RUNS]
)
def test_a_run_is_that_of_the_cpu(either, clip, name):
    arguments = RUNS[name]
    if "depth=file" in arguments:
        arguments = (*arguments, f"depth.options.path={clip / 'depth'}")
    cpu, there, gpu = either(*arguments)
    apart = APART.get(name, 2e-3)
    # Sums in another order (uncertainty has kernels on a CPU) go through all of Gauss-Newton.
    np.testing.assert_allclose(there, cpu, atol=apart * np.ptp(cpu, axis=0).max() + 1e-6)
    assert np.ptp(cpu, axis=0).max() > 0, "nothing moved, so that nothing was compared"
    assert gpu.streams.faults == []
    assert gpu.total() > 0


def test_correspondence_from_the_truth(either):
    arguments = (
        *CPU, "correspondence={name: synthetic, options: {width: 96, height: 64}}",
        "reader={name: synthetic, options: {width: 96, height: 64}}", "input.max_frames=13",
    )  # fmt: skip
    cpu, there, _ = either(*arguments, source="synthetic:handheld")
    np.testing.assert_allclose(there, cpu, atol=1e-4 * np.ptp(cpu, axis=0).max())


def network_of(part):
    """The network inside a built part, and in which precision it multiplies."""
    return getattr(part, "net", None) or part._network, getattr(part, "mixed", None)


@pytest.mark.parametrize("preset", ["paper", "droid-slam"])
def test_half_precision_of_the_networks(go, gpu, preset, monkeypatch):
    """By default networks multiply in float16, and bundle adjustment gets float32."""
    seen = {"problem": set(), "parts": None}
    step, made = TorchBundleAdjuster.step, SlamSystem.__init__

    def stepped(self, problem):
        floats = (problem.T_cw, problem.disps, problem.intrinsics, problem.target, problem.weight)
        seen["problem"] |= {(tensor.dtype, tensor.device.type) for tensor in floats}
        return step(self, problem)

    def built(self, config, parts, *args, **kwargs):
        seen["parts"] = parts
        made(self, config, parts, *args, **kwargs)

    monkeypatch.setattr(TorchBundleAdjuster, "step", stepped)
    monkeypatch.setattr(SlamSystem, "__init__", built)
    small = [SMALL.replace(", precision: float32", "")] if preset == "paper" else []
    code, wrong, centres = go("cuda", "--preset", preset, "ba=torch", *small)
    assert code == 0, wrong
    assert np.isfinite(centres).all() and gpu.streams.faults == []
    assert seen["problem"] == {(torch.float32, "cuda")}
    parts = seen["parts"]
    network, mixed = network_of(parts.correspondence)
    assert mixed == torch.float16 and network.fnet.conv1.weight.is_cuda
    for part in (parts.features, parts.depth) if preset == "paper" else ():
        network, _ = network_of(part)
        linear = next(m for m in network.modules() if isinstance(m, torch.nn.Linear))
        assert linear.weight.dtype == torch.float16 and linear.weight.is_cuda


SLOTS = ("features", "depth", "uncertainty", "ba", "correspondence")
TRIED = {
    "features": {"cnn", "dinov2", "fit3d", "none"},
    "depth": {"file", "metric3d", "none"},
    "uncertainty": {"affine-softplus", "mlp", "none", "per-pixel"},
    "ba": {"torch"},
    "correspondence": {"droid", "flow", "synthetic"},
}
"""What the runs above use on the pretended GPU."""
ELSEWHERE = {
    "cuda": "kernels behind raw pointers: tests/bundle runs them as a loop on the CPU",
    "auto": "takes one of the others",
    "native": "runs on a CPU only, and says so",
}


def test_no_part_is_left_out():
    offered = {slot: droidw.load_plugins(environ={}).registry(slot).names() for slot in SLOTS}
    left = {
        slot: [name for name in names if name not in TRIED[slot] and name not in ELSEWHERE]
        for slot, names in offered.items()
    }
    assert not any(left.values()), f"parts that no test runs on a (pretended) GPU: {left}"


def test_what_does_not_run_there_says_what_does(go):
    with PretendGpu():
        code, wrong, _ = go("cuda", "--preset", "cpu", "ba=native")
    assert code == 2
    assert "ba 'native' does not run on cuda" in wrong
    assert "it runs on: cpu; choose another device, or ba=auto or ba=cuda or ba=torch" in wrong


def test_auto_stays_on_the_processor_with_a_part_that_computes_there(go):
    with PretendGpu() as gpu:
        code, wrong, _ = go("auto", "--preset", "cpu", "ba=torch", "input.max_frames=3")
    assert code == 0, wrong
    assert gpu.total() == 0


def test_auto_takes_a_gpu_that_all_parts_use(go):
    with PretendGpu() as gpu:
        code, wrong, _ = go("auto", "--preset", "droid-slam", "ba=torch", "input.max_frames=3")
    assert code == 0, wrong
    assert gpu.total() > 0
