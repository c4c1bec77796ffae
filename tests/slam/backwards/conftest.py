"""Runs whose path is tracked from the last keyframe to the first, and stand-ins for that."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import BackendConfig, CameraConfig, DroidwConfig
from droidw.events import Dispatcher
from droidw.geometry.camera import Grid
from droidw.geometry.projective import reproject
from droidw.geometry.se3 import exp, mul
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.slam import backwards as module
from droidw.slam.backwards import doubted
from droidw.slam.diagnosis import Diagnosis
from droidw.slam.doubt import Link
from droidw.slam.optimise import Optimiser, Parts
from droidw.slam.path import Path
from droidw.slam.timing import Stopwatch
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

H, W, COUNT, WARM = 8, 12, 14, 4
GRID, INTRINSICS = Grid(H, W, 8, 3.5), torch.tensor([82.0, 82.0, 47.5, 31.5])


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
    made.frontend = replace(made.frontend, warmup=WARM, again_below=0.0)
    made.backend = BackendConfig(passes=[1, 1], backwards_below=1.0, turns=2)
    return made


def bent(store, agreement, mark=1.0):
    """Another path of the keyframes; `mark` of it is in its depths."""
    k = torch.arange(float(len(store)))[:, None]
    bend = exp(k * torch.tensor([0.0, 0.1, 0.0, 0.0, 0.0, 0.01]))
    made = Path.of(store, agreement)
    return replace(made, T_cw=mul(bend, store.T_cw), disps=torch.full_like(made.disps, mark))


def diagnosed(agreement, **more):
    """What a run says of itself of which so much agrees."""
    return Diagnosis(COUNT, COUNT, still=False, lost=0.0, agreement=agreement, **more)


@pytest.fixture
def diagnosis():
    """`diagnosis(agreement)`, see `diagnosed`."""
    return diagnosed


class Settled:
    """What `doubted` makes of a way back.

    Args:
        found: agreement of the way back; None if it was given up, or what it fails with.
        piece: intervals of the other way that agree more, and whether they hold.
        again: agreement of the way there, measured once more before both are compared.
        adjusted: agreement after each further global adjustment, or what it fails with.
        stopped: whether the run is to end, once the way back is found.
        links: where the run, the way there measured once more, and the way back hang together
            least.
        mark: of the depths of the way back. halves: whether further adjustments halve what all
            inverse depths are off 1, in logarithms.
    Attributes:
        learned: for each global adjustment after the way back, whether uncertainty was to learn.
        passes: updates and kernel of each of these, none with the wide one.
        priors: how much steady motion counted in each of these.
        points: matches of points that counted in each of these, and how much.
        begun: mean logarithm of the inverse depths from which each of these set out.
    """

    def __init__(self, optimiser, config, monkeypatch, found, agreement=0.5, **more):
        self.asked, self.learned, self.passes, self.compared = 0, [], [], 0
        self.priors, self.begun, self.points = [], [], []
        self.more = {"piece": (), "holds": True, "again": agreement, "adjusted": 0.7} | more
        self.links = [Link(share, 7) for share in self.more.get("links", (0.5, 0.5, 0.5))]
        mark = self.more.get("mark", 1.0)
        self.found = found
        if isinstance(found, float):
            self.found = replace(bent(optimiser.store, found, mark), weakest=self.links[2])
        monkeypatch.setattr(module, "track_backwards", self.track)
        monkeypatch.setattr(module, "support", self.support)
        monkeypatch.setattr(module.Backend, "run", lambda backend, tell: self.adjust(backend, tell))
        self.events = Dispatcher()
        diagnosis = diagnosed(agreement, weakest=self.links[0])
        stopped = self.more.get("stopped", False)
        self.kept = doubted(
            optimiser, config, diagnosis, self.events, lambda: stopped and self.asked > 0
        )

    def track(self, *arguments):
        self.asked += 1
        if isinstance(self.found, Exception):
            raise self.found
        return deepcopy(self.found)  # what is kept is compared with what was found

    def support(self, optimiser, path):
        """Asked of the path that is kept, of the other one, and of what was made of both."""
        self.compared += 1
        between = torch.ones(COUNT - 1, dtype=torch.float64)
        if self.compared > 1:
            better = self.compared == 2 or self.more["holds"]
            between[list(self.more["piece"])] *= 3.0 if better else 0.5
        return between

    def adjust(self, backend, tell):
        made = [(part.updates, part.kernel) for part in backend.passes]
        if not self.asked:
            assert not backend.config.schedule["global"].learn
            self.there = made
            backend.agreement, backend.weakest = self.more["again"], self.links[1]
            return
        self.passes.append(made)
        self.learned.append(backend.config.schedule["global"].learn)
        self.priors.append(backend.motion_prior)
        self.points.append(backend.optimiser.points)
        disps = backend.optimiser.store.disps
        self.begun.append(float(disps.log().mean()))
        if self.more.get("halves"):
            disps.sqrt_()
        if isinstance(self.more["adjusted"], Exception):
            raise self.more["adjusted"]
        for done in (1, 2):
            tell(done, 2)
        backend.agreement = self.more["adjusted"]


@pytest.fixture
def settled(optimiser, config, monkeypatch):
    """`settled(found, agreement, **more)`: what becomes of a way back, see `Settled`."""

    def make(found, *agreement, **more):
        return Settled(optimiser, config, monkeypatch, found, *agreement, **more)

    return make
