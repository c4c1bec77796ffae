"""The numbers of the published network with the same weights.

`data/parity.npz` holds the inputs and small outputs of the published network in full, and every
97th value of the large outputs. Where the whole file is at hand it is compared too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from droidw_plugins.correspondence._droid_corr import Pyramid, lookup, lookup_lowmem, volume
from droidw_plugins.correspondence._droid_net import upsample_convex

THIN = Path(__file__).parent / "data" / "parity.npz"
WHOLE = Path(__file__).resolve().parents[3] / "shared" / "parity" / "droid_net_a.npz"
# Relative error that is allowed; the mask was stored in half precision.
LIMITS = {
    "fmaps": 1e-4, "net": 1e-4, "inp": 1e-4, "corr": 1e-4, "net_out": 1e-4, "delta": 1e-4,
    "weight": 1e-4, "eta": 1e-4, "upmask": 2e-3, "disp_up": 1e-4,
}  # fmt: skip


@pytest.fixture(scope="module")
def computed(net):
    """Every array of the file, from its inputs and our own intermediate results."""
    given = np.load(THIN)
    tensor = {name: torch.from_numpy(given[name]) for name in given.files}
    images = tensor["images_bgr"][0].flip(1).float() / 255
    ii, jj = tensor["ii"], tensor["jj"]
    with torch.no_grad():
        fmaps = net.features(images)
        hidden, inp = net.context(images)
        pyramid = Pyramid(*fmaps.shape[-2:])
        columns = [pyramid.features(f) for f in fmaps]
        volumes = [volume(fmaps[i], columns[j]) for i, j in zip(ii, jj, strict=True)]
        corr = lookup(volumes, tensor["coords"][0], pyramid)
        sources, which = torch.unique(ii, return_inverse=True)
        new = net.update(hidden[ii], inp[sources], corr, tensor["motion"][0], which)
        mean = torch.stack([new.gathered[which == u].mean(dim=0) for u in range(len(sources))])
        features = net.update.features(mean)
        mask = net.update.upmask(features)
        found = {
            "fmaps": fmaps, "net": hidden, "inp": inp, "corr": corr, "net_out": new.net,
            "delta": new.delta, "weight": new.weight, "eta": net.update.damping(features),
            "upmask": mask, "disp_up": upsample_convex(tensor["disp"][0], mask, "zeros"),
        }  # fmt: skip
        pairs = [(fmaps[i], columns[j]) for i, j in zip(ii, jj, strict=True)]
        found["lowmem"] = lookup_lowmem(pairs, tensor["coords"][0], pyramid)
    return {name: value.contiguous().numpy() for name, value in found.items()}


def relative(found, expected):
    expected = expected.astype(np.float64)
    return np.linalg.norm(found.astype(np.float64) - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("name", LIMITS)
def test_array_of_the_published_network(computed, name):
    expected = np.load(THIN)[name]
    found = computed[name].ravel()
    if expected.size != found.size:
        found = found[::97]
    assert relative(found, expected.ravel()) < LIMITS[name]


def test_low_memory_correlation_of_the_published_network(computed):
    assert relative(computed["lowmem"].ravel()[::97], np.load(THIN)["corr"]) < 1e-4


@pytest.mark.parametrize("name", LIMITS)
def test_whole_array_of_the_published_network(computed, name):
    if not WHOLE.is_file():
        pytest.skip(f"{WHOLE} is not here; every 97th value was compared")
    expected = np.load(WHOLE)[name]
    assert expected.shape[1:] == computed[name].shape
    assert relative(computed[name], expected[0]) < LIMITS[name]
