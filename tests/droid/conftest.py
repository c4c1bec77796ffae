"""Rule-made weights of the DROID network, and payloads made with them."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.geometry.projective import pixel_grid
from droidw.interfaces.correspondence import EdgeRequest
from droidw.slam.frame import Frame
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
