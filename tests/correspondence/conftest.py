"""The operator `flow`, two pictures for it, and the question about the edge between them."""

from __future__ import annotations

import pytest
import torch

from droidw.geometry.camera import Grid
from droidw.interfaces.correspondence import EdgeRequest
from droidw.plugin.component import BuildContext
from droidw.slam.frame import Frame
from droidw_plugins.correspondence import flow


@pytest.fixture(scope="session")
def operator():
    """`operator(**options)`: the part, of one thread."""

    def call(**options):
        made = flow.COMPONENT.options(workers=1, **options)
        return flow.COMPONENT.factory(made, BuildContext(device=torch.device("cpu")))

    return call


@pytest.fixture(scope="session")
def frame():
    """`frame(index, grey, mask=None)` from grey levels [H,W] and a mask [H,W] in numpy."""

    def call(index, grey, mask=None):
        image = torch.from_numpy(grey / 255).float().expand(3, -1, -1).contiguous()
        camera = torch.tensor([200.0, 200.0, 104.0, 80.0])
        known = None if mask is None else torch.from_numpy(mask)
        return Frame(index, index / 10, image, camera, str(index), known)

    return call


@pytest.fixture(scope="session")
def question():
    """`question(part, frames)`: of the edge from the first to the second, where nothing is known.

    Nothing is predicted to move, so that `coords` are the cells themselves.
    """

    def call(part, frames):
        height, width = frames[0].image.shape[-2:]
        grid = Grid.of(height, width, part.stride, part.offset)
        payload = [part.encode(f, grid) for f in frames]
        y, x = torch.meshgrid(
            torch.arange(float(grid.height)), torch.arange(float(grid.width)), indexing="ij"
        )
        coords = torch.stack([x, y], dim=-1)[None]
        valid = torch.ones(coords.shape[:3], dtype=torch.bool)
        return EdgeRequest([0], [0], [1], coords, valid, payload.__getitem__, informed=False)

    return call
