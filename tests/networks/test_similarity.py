"""After calibration, "consistent" is the same number for all feature extractors.

Rendered rooms with exact correspondence: a scale is found from the matches of some pairs of
pictures, of what moves as of what stands still, and held against static cells of others.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from droidw.geometry.camera import Grid
from droidw.interfaces.uncertainty import UncertaintyView
from droidw.plugin.component import BuildContext
from droidw.testing.scenes import Scene, SceneSpec
from droidw_plugins.features import cnn, dinov2, fit3d
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty._matches import MEDIAN, QUARTILE, MatchScale, matches

CPU = BuildContext(torch.device("cpu"))
GRID = Grid.of(240, 320, 8, 3.5)
SEEN, UNSEEN = ((0, 8), (15, 24), (40, 50)), ((8, 16), (28, 36), (50, 58))
TOLERANCE = 0.02
"""Of quartile and median of the similarity of static cells in pictures the scale has not seen."""


class RandomConvolutions:
    """Two layers that nobody trained: positive features, nearly all alike (cosines above 0.9)."""

    def __init__(self):
        draw = torch.Generator().manual_seed(0)
        self.first = torch.randn(16, 3, 5, 5, generator=draw) * 0.16
        self.second = torch.randn(48, 16, 5, 5, generator=draw) * 0.07

    def extract(self, image, grid):
        x = F.conv2d(image[None], self.first, stride=2, padding=2).relu()
        x = F.conv2d(x, self.second, stride=2, padding=2).relu()
        return F.avg_pool2d(x, 2)[0, :, : grid.height, : grid.width]


class Colours:
    """The colours of a patch, as they are."""

    def extract(self, image, grid):
        patches = F.unfold(F.avg_pool2d(image[None], 4), 2, stride=2)
        return patches[0].view(-1, grid.height, grid.width)


@pytest.fixture(scope="module")
def extractors(checkpoint):
    """name -> a fresh extractor; transformers with made-up weights and raw features."""

    def transformer(module, options):
        weights = str(checkpoint("fit3d" if module is fit3d else "dinov2-vits14-reg"))
        return module.COMPONENT.factory(options(weights=weights), CPU)

    return {
        "cnn": lambda: cnn.COMPONENT.factory(cnn.CnnOptions(), CPU),
        "cnn, raw": lambda: cnn.COMPONENT.factory(
            cnn.CnnOptions(calibration="none", constant=0.0), CPU
        ),
        "dinov2": lambda: transformer(dinov2, dinov2.Dinov2Options),
        "fit3d": lambda: transformer(fit3d, fit3d.Fit3dOptions),
        "random": RandomConvolutions,
        "colours": Colours,
    }


@pytest.fixture(scope="module")
def scene():
    rendered = Scene(SceneSpec(frames=60, noise=3.0, seed=3))
    pictures = {}
    for index in {n for pair in (*SEEN, *UNSEEN) for n in pair}:
        image = torch.from_numpy(rendered.render(index).image)
        pictures[index] = image.permute(2, 0, 1).float() / 255
    return rendered, pictures


def view_of(scene, extractor, pairs):
    """Features of the pictures, exact matches as measured ones, and which cells stand still."""
    rendered, pictures = scene
    frames = sorted({n for pair in pairs for n in pair})
    y, x = np.mgrid[: GRID.height, : GRID.width] * 8 + 3.5
    target, confidence, still = [], [], []
    for i, j in pairs:
        found = rendered.correspond(i, j, np.stack([x, y], axis=-1))
        target.append(torch.from_numpy((found.target - 3.5) / 8).float())
        confidence.append(torch.from_numpy(found.visible).float()[..., None].repeat(1, 1, 2))
        still.append(torch.from_numpy(found.visible & ~found.moving).flatten())
    features = torch.stack([extractor.extract(pictures[n], GRID) for n in frames])
    none = torch.zeros(0)
    view = UncertaintyView(
        features=features, uncertainty=none, fields={}, T_cw=none,
        disps=torch.ones(len(frames), GRID.height, GRID.width), intrinsics=none,
        ii=torch.tensor([frames.index(i) for i, _ in pairs]),
        jj=torch.tensor([frames.index(j) for _, j in pairs]),
        target=torch.stack(target), confidence=torch.stack(confidence), frames=none,
    )  # fmt: skip
    return view, torch.stack(still)


def similarities(view):
    """Cosines [E,P] at the measured matches, and the weights of these."""
    samples, weight = matches(view, torch.ones(len(view.ii), dtype=torch.bool), 0)
    rows = view.features.flatten(2).transpose(1, 2).float()
    return objective.similarity(rows, samples), weight


def quantiles(cosine, still):
    """Quartile and median of the similarity of what stands still."""
    return np.percentile(cosine[still].numpy(), [25, 50])


WANTED = np.array([1 - QUARTILE, 1 - MEDIAN])


@pytest.mark.parametrize("name", ["cnn, raw", "dinov2", "fit3d", "random", "colours"])
def test_consistent_means_the_same(name, extractors, scene):
    extractor = extractors[name]()
    scale = MatchScale()
    view, _ = view_of(scene, extractor, SEEN)
    scale.look(*similarities(view))
    view, still = view_of(scene, extractor, UNSEEN)
    cosine, _ = similarities(view)
    assert still.float().mean() > 0.5
    # Raw, it is another number for each: here between 0.69 and 0.998, and 0.85 and 0.9996.
    assert np.abs(quantiles(cosine, still) - WANTED).max() > 2 * TOLERANCE
    assert np.abs(quantiles(scale(cosine), still) - WANTED).max() < TOLERANCE


def test_cnn_is_calibrated_as_it_is(extractors, scene):
    extractor = extractors["cnn"]()
    assert extractor.calibrated and not extractors["cnn, raw"]().calibrated
    assert not getattr(extractors["fit3d"](), "calibrated", False)
    view, still = view_of(scene, extractor, UNSEEN)
    assert np.abs(quantiles(similarities(view)[0], still) - WANTED).max() < TOLERANCE
