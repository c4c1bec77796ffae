"""Keyframes tracked from the last to the first, and when that is kept."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import BackendConfig, CameraConfig, DroidwConfig
from droidw.events import Dispatcher, Progress
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import exp, inv, mul
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam import backwards as module
from droidw.slam.backwards import WayBack, doubted, track_backwards
from droidw.slam.diagnosis import Diagnosis
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.timing import Stopwatch
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

H, W, COUNT, WARM = 8, 12, 14, 4
GRID, INTRINSICS = Grid(H, W, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5])


def relative(T_cw):
    """Every pose seen from the first one, [N,7]."""
    return mul(T_cw, inv(T_cw[:1]).expand_as(T_cw))


@pytest.fixture
def truth(arc, waves):
    """Poses and disparities of all keyframes."""
    return arc(COUNT), waves(COUNT, H, W)


@pytest.fixture
def optimiser(truth, stored):
    """Of a run that measures exactly; its last poses are right, those before are astray."""
    T_cw, disps = truth

    def measured(request):
        # The store of the way back holds keyframes in another order: `index` tells them apart.
        index = torch.tensor([request.payload(k) for k in range(1 + max(request.ii + request.jj))])
        ii, jj = index[torch.tensor(request.ii)], index[torch.tensor(request.jj)]
        target, valid = reproject(T_cw, disps, GRID.intrinsics(INTRINSICS), ii, jj)
        return EdgeUpdate(target, valid[..., None].float().expand_as(target).contiguous())

    session = SimpleNamespace(update=measured, forget=lambda ids: None)
    operator = SimpleNamespace(session=lambda _: session)
    parts = Parts(None, None, None, TorchBundleAdjuster(), operator)
    off = exp(torch.tensor([0.1, -0.05, 0.0, 0.05, 0.1, 0.05])).expand(COUNT - WARM, -1)
    astray = torch.cat([mul(off, T_cw[: COUNT - WARM]), T_cw[COUNT - WARM :]])
    store = stored(GRID, INTRINSICS.clone(), astray, disps)
    for k, info in enumerate(store.infos):
        info.payload = k
    return Optimiser(store, parts, DroidwConfig().weighting, Stopwatch())


@pytest.fixture
def config():
    """Of a run that doubts all; uncertainty does not learn here, as there is none."""
    made = DroidwConfig(camera=CameraConfig(refine_focal=False))
    made.frontend = replace(made.frontend, warmup=WARM)
    made.backend = BackendConfig(passes=[1, 1], backwards_below=1.0)
    return made


def track(optimiser, config, stopped=lambda: False):
    told = []
    back = track_backwards(optimiser, config, lambda *news: told.append(news), stopped)
    return back, told


def test_the_way_back_finds_what_the_way_there_lost(optimiser, config, truth):
    before = optimiser.store.T_cw.clone()
    back, told = track(optimiser, config)
    assert torch.equal(optimiser.store.T_cw, before)
    assert [info.index for info in back.store.infos] == list(range(COUNT))[::-1]
    assert back.agreement > 0.99
    back.write_to(optimiser.store)
    found, right = relative(optimiser.store.T_cw), relative(truth[0])
    # Monocular: all but the scale.
    scale = (found[:, :3] * right[:, :3]).sum() / right[:, :3].square().sum()
    assert torch.allclose(found[:, :3] / scale, right[:, :3], atol=5e-3)
    assert torch.allclose(found[:, 3:], right[:, 3:], atol=5e-3)
    assert told == [(k, COUNT + 2) for k in range(COUNT)] + [(COUNT + k, COUNT + 2) for k in (1, 2)]


def test_the_first_pose_of_the_run_and_all_else_stay(optimiser):
    store = optimiser.store
    first, times = store.T_cw[0].clone(), store.times()
    WayBack(turned(store), 1.0).write_to(store)
    assert torch.allclose(store.T_cw[0], first, atol=1e-6)
    assert store.times() == times
    assert [info.index for info in store.infos] == list(range(COUNT))


def test_uncertainty_stays_as_it_has_learned_to_be(optimiser, config):
    store = optimiser.store
    known = 0.01 * torch.arange(1.0, 1 + COUNT)[:, None, None].expand(COUNT, H, W)
    store["uncertainty"].copy_(known)
    back, _ = track(optimiser, config)
    assert torch.equal(back.store["uncertainty"].flip(0), known)
    back.write_to(store)
    assert torch.equal(store["uncertainty"], known)


def test_learned_damping_and_full_maps_come_along(optimiser):
    back = WayBack(turned(optimiser.store), 1.0)
    back.store["damping"].copy_(torch.arange(COUNT)[:, None, None].expand(COUNT, H, W).float())
    for k, info in enumerate(back.store.infos):
        info.disp_full = k
    back.write_to(optimiser.store)
    assert optimiser.store["damping"][:, 0, 0].tolist() == list(range(COUNT))[::-1]
    assert [info.disp_full for info in optimiser.store.infos] == list(range(COUNT))[::-1]


@pytest.mark.parametrize("after", [0, WARM - 1, COUNT - 1, COUNT, COUNT + 1])
def test_a_run_that_is_to_end_gives_it_up(optimiser, config, after):
    asked = iter(range(COUNT + 3))
    back, told = track(optimiser, config, lambda: next(asked) >= after)
    assert back is None
    assert len(told) == after


def test_too_few_keyframes_are_left_alone(optimiser, config):
    config.frontend.warmup = COUNT
    assert track(optimiser, config) == (None, [])


class Heard:
    """Keeps all events."""

    def __init__(self):
        self.events = []

    def on_event(self, event):
        self.events.append(event)


def turned(store):
    """The keyframes last first, with a bend in their path."""
    other = store.blank()
    for k in reversed(range(len(store))):
        bend = exp(torch.tensor([0.0, 0.1, 0.0, 0.0, 0.0, 0.01]) * k)
        other.append(
            replace(store.infos[k]), **store.values(k) | {"T_cw": mul(bend, store.T_cw[k])}
        )
    return other


def settle(optimiser, config, monkeypatch, found, agreement=0.5):
    """What `doubted` makes of a way back that `found` does, and the dispatcher."""
    made = turned(optimiser.store)
    asked = []

    def tracked(*arguments):
        asked.append(arguments)
        if isinstance(found, Exception):
            raise found
        return None if found is None else WayBack(made, found)

    monkeypatch.setattr(module, "track_backwards", tracked)
    events = Dispatcher()
    diagnosis = Diagnosis(COUNT, COUNT, still=False, lost=0.0, agreement=agreement)
    kept = doubted(optimiser, config, diagnosis, events, lambda: False)
    return kept, events, len(asked)


@pytest.mark.parametrize("found", [0.5, 0.4, float("nan"), None, RuntimeError("no memory")])
def test_what_was_found_first_stays_unless_more_agrees(optimiser, config, monkeypatch, found):
    before = optimiser.store.T_cw.clone()
    kept, events, asked = settle(optimiser, config, monkeypatch, found)
    assert asked == 1
    assert (kept.agreement, kept.backwards) == (0.5, False)
    assert torch.equal(optimiser.store.T_cw, before)
    assert any("no memory" in text for text in events.warnings) == isinstance(found, Exception)


def test_the_way_back_is_kept_where_more_agrees(optimiser, config, monkeypatch):
    before = optimiser.store.T_cw.clone()
    kept, _, _ = settle(optimiser, config, monkeypatch, 0.6)
    assert (kept.agreement, kept.backwards) == (0.6, True)
    assert not torch.allclose(optimiser.store.T_cw, before, atol=1e-3)


@pytest.mark.parametrize(
    ("below", "agreement", "asked"),
    [(0.7, 0.69, 1), (0.7, 0.7, 0), (0.0, 0.0, 0), (1.0, 1.0, 1), (0.7, float("nan"), 0)],
)
def test_only_doubt_asks_for_it(optimiser, config, monkeypatch, below, agreement, asked):
    config.backend.backwards_below = below
    assert settle(optimiser, config, monkeypatch, None, agreement)[2] == asked


def test_it_is_told_how_far_it_is(optimiser, config):
    heard = Heard()
    diagnosis = Diagnosis(COUNT, COUNT, still=False, lost=0.0, agreement=0.5)
    doubted(optimiser, config, diagnosis, Dispatcher([("heard", heard)]), lambda: False)
    assert heard.events[-1] == Progress("backwards", COUNT + 2, COUNT + 2)
