"""Tensors live where the run lives: nothing is made on the CPU on the way."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.geometry.projective import pixel_grid
from droidw.interfaces.correspondence import EdgeRequest
from droidw.slam.frame import Frame
from droidw_plugins.correspondence._droid import DroidCorrespondence
from droidw_plugins.correspondence._droid_net import DroidNet
from droidw_plugins.correspondence.droid import DroidOptions

PAIRS = [(0, 1), (1, 0), (1, 2), (2, 1)]


def pictures(device, count=3):
    g = torch.Generator().manual_seed(0)
    K = torch.tensor([80.0, 80.0, 48.0, 32.0])
    return [Frame(k, k / 30, torch.rand(3, 64, 96, generator=g), K) for k in range(count)]


def request(payloads, device):
    coords = pixel_grid(8, 12, device=device).expand(len(PAIRS), 8, 12, 2) + 0.3
    ii, jj = [i for i, _ in PAIRS], [j for _, j in PAIRS]
    return EdgeRequest(
        list(range(len(PAIRS))), ii, jj, coords, coords[..., 0] > -9, payloads.__getitem__
    )


@pytest.mark.parametrize("correlation", ["volume", "lowmem"])
@pytest.mark.parametrize("purpose", ["window", "global", "fill"])
def test_another_device(make_state, monkeypatch, purpose, correlation):
    """On the device `meta` an operation with a tensor of the CPU is an error, as on a GPU."""
    device = torch.device("meta")
    part = DroidCorrespondence(
        DroidNet.from_state(make_state(), device), DroidOptions(correlation=correlation), device
    )
    monkeypatch.setattr(part, "computing", nullcontext)  # there is no autocast for it
    grid = Grid.of(64, 96, 8, 0.0)
    payloads = [part.context(part.encode(f, grid), f, grid) for f in pictures(device)]
    session = part.session(purpose)
    for _ in range(2):
        answer = session.update(request(payloads, device))
        assert answer.target.device == answer.confidence.device == device
    assert (answer.damping is None) == (purpose == "fill")
    if purpose == "global":
        fine = session.upsample(1, torch.ones(8, 12, device=device))
        assert fine.shape == (64, 96) and fine.device == device


@pytest.fixture
def exact(monkeypatch):
    """No TF32, as in a run (`droidw.run.machine.settle`); torch lets convolutions have it."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    monkeypatch.setattr(torch.backends.cuda.matmul, "allow_tf32", False)


@pytest.mark.gpu
@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize(("precision", "limit"), [("float32", 1e-3), ("auto", 5e-2)])
def test_a_gpu_gives_the_numbers_of_the_cpu(make_state, device, precision, limit):
    answers = []
    for where, options in (
        (torch.device("cpu"), DroidOptions(store="float")),
        (device, DroidOptions(precision=precision, store="float")),
    ):
        part = DroidCorrespondence(DroidNet.from_state(make_state(), where), options, where)
        grid = Grid.of(64, 96, 8, 0.0)
        frames = pictures(where)
        payloads = [part.context(part.encode(f, grid), f, grid) for f in frames]
        moved = part.motion(payloads[0], part.encode(frames[2], grid)).flow
        session = part.session()
        session.update(request(payloads, where))
        answer = session.update(request(payloads, where))
        answers.append((answer, moved))
    (cpu, cpu_moved), (gpu, gpu_moved) = answers
    start = request([], torch.device("cpu")).coords
    for name in ("target", "confidence", "damping", "upmask"):
        a, b = getattr(cpu, name), getattr(gpu, name).cpu()
        reference = (a - start) if name == "target" else a
        assert float((a - b).norm() / reference.norm()) < limit, name
    assert gpu_moved == pytest.approx(cpu_moved, rel=limit)
