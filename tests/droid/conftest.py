"""Rule-made weights of the DROID network, and payloads made with them."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

import droidw
from droidw.config.load import load_config
from droidw.config.resolve import resolve
from droidw.geometry.camera import Camera, Grid
from droidw.geometry.projective import pixel_grid
from droidw.interfaces.correspondence import EdgeRequest, EdgeUpdate, Motion
from droidw.plugin.component import BuildContext
from droidw.slam.frame import Frame
from droidw.slam.optimise import Parts
from droidw.slam.system import SlamSystem
from droidw.solve.problem import Report, Step
from droidw.testing.scenes import Scene, SceneSpec
from droidw_plugins.correspondence._droid import DroidCorrespondence
from droidw_plugins.correspondence._droid_net import DroidNet
from droidw_plugins.correspondence._droid_state import expected_shapes
from droidw_plugins.correspondence.droid import DroidOptions

CPU = torch.device("cpu")


def rule_state(salt="droidw-parity/"):
    """Weights that depend on nothing but salt, key and shape, of a size that keeps signals."""
    state = {}
    for key, shape in expected_shapes().items():
        seed = zlib.crc32((salt + key).encode()) & 0x7FFFFFFF
        scale = np.sqrt(2 / np.prod(shape[1:])) if len(shape) > 1 else 0.05
        values = np.random.RandomState(seed).standard_normal(shape) * scale
        state[key] = torch.from_numpy(values.astype(np.float32))
    return state


@pytest.fixture(scope="session")
def make_state():
    return rule_state


@pytest.fixture(scope="session")
def net():
    return DroidNet.from_state(rule_state())


@pytest.fixture
def operator(net):
    """Build the operator: `operator(published=False, store="float", ...)`."""

    def build(published=False, network=net, **options):
        return DroidCorrespondence(
            network, DroidOptions(**{"store": "float", **options}), CPU, published
        )

    return build


@pytest.fixture(scope="session")
def frames():
    """Four pictures of 96x64 of a camera that moves, as frames."""
    scene = Scene(SceneSpec(width=96, height=64, frames=8, moving=False, motion="handheld"))
    made = []
    for k in range(0, 8, 2):
        image = torch.from_numpy(scene.render(k).image.copy()).permute(2, 0, 1).float() / 255
        intrinsics = torch.from_numpy(scene.intrinsics).float()
        made.append(Frame(k, k / 30, image.contiguous(), intrinsics, f"{k}"))
    return made


@pytest.fixture(scope="session")
def grid():
    return Grid.of(64, 96, 8, 0.0)


@pytest.fixture
def ask(grid):
    """Make a request: `ask(payloads, pairs, ids=None, shift=0.0)`."""

    def request(payloads, pairs, ids=None, shift=0.0):
        cells = pixel_grid(grid.height, grid.width)
        steps = torch.tensor([[0.3 * i - 0.4 * j, 0.2 * j - 0.1 * i] for i, j in pairs])
        coords = cells + shift + steps.view(-1, 1, 1, 2)
        return EdgeRequest(
            list(range(len(pairs))) if ids is None else ids,
            [i for i, _ in pairs],
            [j for _, j in pairs],
            coords,
            torch.ones(coords.shape[:3], dtype=torch.bool),
            payloads.__getitem__,
        )

    return request


@pytest.fixture
def encoded(frames, grid):
    """Payloads of all frames, with context."""

    def encode(part):
        return [part.context(part.encode(f, grid), f, grid) for f in frames]

    return encode


COUNT = 30
BASE = [
    "features=none", "depth=none", "uncertainty=none", "correspondence=synthetic", "ba=torch",
    "motion_filter.threshold=0.5",
]  # fmt: skip


class Counted:
    """Correspondence that agrees with geometry and notes every update of every session.

    Attributes:
        log: (purpose, number of the session, edges). enlarged: (node, map).
    """

    stride, offset = 8, 0.0

    def __init__(self):
        self.log, self.enlarged, self.sessions = [], [], 0

    def encode(self, frame, grid):
        return frame.index

    def context(self, payload, frame, grid):
        return payload

    def motion(self, reference, current):
        return Motion(1.0, 1.0)

    def session(self, purpose="window"):
        self.sessions += 1
        return CountedSession(self, (purpose, self.sessions))


@dataclass
class CountedSession:
    owner: Counted
    name: tuple
    known: set = field(default_factory=set)

    def update(self, request):
        edges = tuple(zip(request.ii, request.jj, strict=True))
        self.owner.log.append((*self.name, edges))
        self.known |= set(request.ids)
        return EdgeUpdate(request.coords.clone(), torch.ones_like(request.coords))

    def forget(self, ids):
        self.known -= set(ids)

    def upsample(self, node, disp):
        self.owner.enlarged.append((node, disp.clone()))
        return disp.repeat_interleave(8, 0).repeat_interleave(8, 1)


class Holds:
    """Bundle adjustment that moves nothing, unless told to."""

    def __init__(self):
        self.factor = 1.0

    def step(self, problem):
        return Step(problem.T_cw.clone(), problem.disps * self.factor, Report("ok", 0.0))


@pytest.fixture
def system_of():
    """Build a system: `system_of("paper", "key=value", events=None)`."""
    return build_system


def build_system(preset, *overrides, events=None):
    """(system, its counted correspondence, frames) of a clip of 30 frames 96x64."""
    plugins = droidw.load_plugins(environ={})
    resolved = resolve(load_config(preset=preset, overrides=[*BASE, *overrides]), plugins)
    context = BuildContext(torch.device("cpu"))
    built = {
        slot: resolved.parts[slot][0].factory(resolved.parts[slot][1], context)
        for slot in ("features", "depth", "uncertainty")
    }
    counted = Counted()
    parts = Parts(**built, ba=Holds(), correspondence=counted)
    camera = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
    system = SlamSystem(resolved.config, parts, camera, torch.device("cpu"), events)
    blank = torch.rand(3, 64, 96, generator=torch.Generator().manual_seed(0))
    frames = [Frame(k, k / 30, blank, camera.intrinsics(), f"{k}") for k in range(COUNT)]
    return system, counted, frames
