"""The pretended GPU has the rules of a real one, and counts every wait."""

from __future__ import annotations

import threading

import pytest
import torch
from torch.nn import functional as F

from droidw.testing.pretend_gpu import GPU, PretendGpu, PretendTensor


@pytest.fixture
def gpu():
    with PretendGpu() as pretended:
        yield pretended


def test_numbers_are_those_of_the_cpu(gpu):
    g = torch.Generator().manual_seed(0)
    picture, kernel = torch.rand(1, 2, 6, 5, generator=g), torch.rand(3, 2, 3, 3, generator=g)
    there = F.conv2d(picture.to("cuda"), kernel.to("cuda"), padding=1)
    assert there.device == GPU and there.is_cuda and isinstance(there, PretendTensor)
    assert torch.equal(there.cpu(), F.conv2d(picture, kernel, padding=1))
    x = torch.zeros(3, 4, device="cuda")
    view = x[1:]
    view += 2
    x[:, 0] = 7.0
    torch.add(x, x, out=x)
    assert x.tolist() == [[14, 0, 0, 0], [14, 4, 4, 4], [14, 4, 4, 4]]
    assert not torch.zeros(2).is_cuda, "what is made on the host stays there"


def test_a_module_moves_as_a_whole(gpu):
    layer = torch.nn.Linear(3, 2)
    expected = layer(torch.ones(3))
    assert layer.to("cuda").weight.device == GPU
    assert torch.equal(layer(torch.ones(3, device="cuda")).detach().cpu(), expected.detach())


@pytest.mark.parametrize("mixed", [
    lambda x: x + torch.ones(4),
    lambda x: torch.cat([x, torch.ones(1)]),
    lambda x: torch.stack([x[0], torch.tensor(1.0)]),
    lambda x: x.index_select(0, torch.tensor([1])),
    lambda x: torch.where(x > 0, x, torch.ones(4)),
    lambda x: x.index_put_((torch.tensor([0, 1], device="cuda"),), torch.ones(2)),
])  # fmt: skip
def test_two_devices_in_one_operation_are_refused(gpu, mixed):
    with pytest.raises(RuntimeError, match="same device"):
        mixed(torch.zeros(4, device="cuda"))


def test_what_torch_lets_pass(gpu):
    x = torch.arange(4.0, device="cuda")
    assert (x + torch.tensor(1.0)).tolist() == [1, 2, 3, 4]
    assert x[torch.tensor([2, 0])].tolist() == [2, 0]
    assert x[[3, 1]].tolist() == [3, 1]
    assert torch.where(x > 1, x, 0.0).tolist() == [0, 0, 2, 3]
    x[1:3].copy_(torch.ones(2))
    assert x.tolist() == [0, 1, 1, 3]
    with pytest.raises(TypeError, match="to host memory first"):
        x.numpy()
    with pytest.raises(RuntimeError, match="no address"):
        x.data_ptr()
    with pytest.raises(RuntimeError, match="too early"):
        x.to("cpu", non_blocking=True)


WAITING = {
    "item": lambda x: x[0].item(),
    "bool": lambda x: bool(x.sum()),
    "float": lambda x: float(x[1]),
    "tolist": lambda x: x.tolist(),
    "cpu": lambda x: x.cpu(),
    "to": lambda x: x.to("cpu"),
    "nonzero": lambda x: x.nonzero(),
    "unique": lambda x: x.unique(),
    "bincount": lambda x: x.long().bincount(),
    "mask": lambda x: x[x > 0],
    "index of the host": lambda x: x[torch.tensor([1])],
    "list": lambda x: x[[1]],
    "number into a place": lambda x: x.__setitem__(x.long(), 1.0),
    "equal": lambda x: torch.equal(x, x),
    "tensor": lambda x: torch.tensor([1, 2], device="cuda"),
    "new_tensor": lambda x: x.new_tensor([1.0]),
    "solve": lambda x: torch.linalg.solve(torch.eye(4, device="cuda"), x),
    "upload": lambda x: torch.ones(2).to("cuda"),
    "not pinned": lambda x: torch.ones(2).to("cuda", non_blocking=True),
    "synchronize": lambda x: torch.cuda.synchronize(),
}


@pytest.mark.parametrize("name", WAITING)
def test_each_wait_is_counted(gpu, name):
    x = torch.arange(4.0, device="cuda")
    before = gpu.total()
    WAITING[name](x)
    assert gpu.total() == before + 1, gpu.waits_by_line()


def test_what_needs_no_wait(gpu):
    x = torch.arange(4.0, device="cuda")
    x[x > 1] = 0.0
    x[1:] *= 2
    x[2:] = x[:2] + torch.tensor(1.0)
    x.index_add_(0, torch.arange(2, device="cuda"), torch.ones(2, device="cuda"))
    torch.where(x > 1, x, 0.0).masked_fill_(x > 0, 1.0)
    torch.ones(2).pin_memory().to("cuda", non_blocking=True)
    L, _ = torch.linalg.cholesky_ex(torch.eye(3, device="cuda"))
    torch.cholesky_solve(torch.ones(3, 1, device="cuda"), L)
    assert gpu.total() == 0, gpu.waits_by_line()


def test_autocast_computes_in_half_precision(gpu):
    x = torch.ones(1, 2, 4, 4, device="cuda")
    layer = torch.nn.Conv2d(2, 3, 3).to("cuda")
    with torch.autocast("cuda", dtype=torch.float16):
        assert layer(x).dtype == (x[0, 0] @ x[0, 0]).dtype == torch.float16
        with torch.autocast("cuda", enabled=False):
            assert layer(x).dtype == torch.float32
    assert layer(x).dtype == torch.float32


def test_other_threads_have_it_too(gpu):
    made = []
    thread = threading.Thread(target=lambda: made.append(torch.zeros(2, device="cuda")))
    thread.start()
    thread.join()
    assert made[0].device == GPU


def test_it_is_gone_afterwards():
    with PretendGpu():
        x = torch.zeros(2, device="cuda")
    assert not torch.cuda.is_available()
    with pytest.raises(RuntimeError, match="outlived"):
        x + 1


def work(x):
    return x + 1


class TestStreams:
    def test_reading_what_another_stream_has_not_finished(self, gpu):
        x = torch.zeros(2, device="cuda")
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            y = work(x)
        assert gpu.streams.faults == []
        work(y)
        assert "stream 0 uses a tensor (2,) that stream 1 may not have finished" in "".join(
            gpu.streams.faults
        )

    def test_not_waiting_for_the_stream_that_made_it(self, gpu):
        x = torch.zeros(2, device="cuda")
        with torch.cuda.stream(torch.cuda.Stream()):
            work(x)
        assert gpu.streams.faults

    def test_an_event_puts_it_in_order(self, gpu):
        side, done = torch.cuda.Stream(), torch.cuda.Event()
        with torch.cuda.stream(side):
            y = work(torch.zeros(2, device="cuda"))
            done.record()
        torch.cuda.current_stream().wait_event(done)
        y.record_stream(torch.cuda.current_stream())
        work(y)
        del y
        assert gpu.streams.faults == []
        assert gpu.streams.used_by[1] > 0

    def test_memory_given_up_too_early(self, gpu):
        side = torch.cuda.Stream()
        with torch.cuda.stream(side):
            y = work(torch.zeros(2, device="cuda"))
        torch.cuda.current_stream().wait_stream(side)
        work(y)
        del y
        assert ["record_stream is missing" in fault for fault in gpu.streams.faults] == [True]

    def test_a_wait_of_the_host_orders_everything(self, gpu):
        with torch.cuda.stream(torch.cuda.Stream()):
            y = work(torch.zeros(2, device="cuda"))
            assert float(y.sum()) == 2.0
        work(y)
        assert gpu.streams.faults == []
