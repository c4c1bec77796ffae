"""Stand-in weights of the paper's single-picture networks, and the published networks' outputs."""

from __future__ import annotations

import zlib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from droidw_plugins._vit.published import FORMS, transformer_shapes
from droidw_plugins.depth._metric3d_net import published_shapes

PARITY = Path(__file__).resolve().parents[3] / "shared" / "parity" / "networks"

FACTORS = {
    ".decoder.depth_regressor.2.weight": 0.15,
    ".update_block.flow_head.conv2d.": 0.04,
    ".update_block.flow_head.conv2n.": 0.1,
    ".update_block.mask.2.weight": 4.0,
}
"""Keep softmax and iterations of Metric3D away from saturation: part of a key -> factor."""


def drawn(key, shape):
    """The tensor that the rule of ../shared/parity/networks/README.md gives to a key."""
    seed = zlib.crc32(f"droidw-parity/{key}".encode()) & 0x7FFFFFFF
    n = np.random.RandomState(seed).standard_normal(shape)
    if key.endswith("pos_embed"):
        n *= 0.5
    elif key.endswith(".gamma"):
        n = 0.1 + 0.02 * n
    elif len(shape) == 1:
        n = 0.05 * n + (1.0 if key.endswith(".weight") else 0.0)
    else:
        n *= np.sqrt(2.0 / np.prod(shape[1:]))
    for part, factor in FACTORS.items():
        if part in key:
            n *= factor
    return torch.from_numpy(n.astype(np.float32))


def shapes_of(name):
    if name in FORMS:
        return transformer_shapes(*FORMS[name])
    return published_shapes(name.removeprefix("metric3d-"))


def made_up(name):
    shapes = shapes_of(name)
    first = {k: v for k, v in shapes.items() if ".norm3." not in k}
    state = {key: drawn(key, shape) for key, shape in first.items()}
    for key in shapes:
        if ".norm3." in key:
            state[key] = state[key.replace(".norm3.", ".downsample.1.")].clone()
    return state


@cache
def remembered(name):
    return made_up(name)


@pytest.fixture(scope="session")
def stand_in():
    """name of weights -> state dict as published, made up by the rule; not to be changed."""
    # The large network is used once, and would stay in memory with its 1.7 GB.
    return lambda name: made_up(name) if name.endswith("large") else remembered(name)


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory):
    """name of weights -> path of a checkpoint as published, with stand-in weights."""
    folder = tmp_path_factory.mktemp("checkpoints")

    def path(name):
        file = folder / f"{name}.pth"
        if not file.exists():
            state = remembered(name)
            torch.save({"model_state_dict": state} if name not in FORMS else state, file)
        return file

    return path


@pytest.fixture(scope="session")
def parity():
    """file below ../shared/parity/networks -> its arrays as tensors; skips where it is absent."""

    def read(name):
        if not PARITY.is_dir():
            pytest.skip(f"the published networks' outputs are not here: there is no {PARITY}")
        with np.load(PARITY / name) as arrays:
            return {key: torch.from_numpy(np.asarray(arrays[key])) for key in arrays}

    return read


@pytest.fixture(scope="session")
def key_list():
    """name of a key list in ../shared/parity/networks -> {key: shape}."""
    import json

    def read(name):
        if not PARITY.is_dir():
            pytest.skip(f"the published networks' keys are not here: there is no {PARITY}")
        return {k: tuple(v) for k, v in json.loads((PARITY / name).read_text()).items()}

    return read


@pytest.fixture(scope="session")
def normalised():
    """[H,W,3] uint8 -> network input [1,3,H,W], in float64 until the end."""

    def make(image):
        mean = torch.tensor([0.485, 0.456, 0.406], dtype=torch.float64)
        std = torch.tensor([0.229, 0.224, 0.225], dtype=torch.float64)
        return ((image.double() / 255 - mean) / std).permute(2, 0, 1)[None].float()

    return make
