"""What the classifier behind `cnn` says of what can move."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from torch.nn import functional as F

from droidw.errors import ConfigError
from droidw.geometry.camera import Grid
from droidw.plugin.component import BuildContext
from droidw_plugins.features._cnn import CnnFeatures, find_weights
from droidw_plugins.features._efficientnet import BLOCKS, load_classifier
from droidw_plugins.features._movable import MOVABLE, MovableClassifier
from droidw_plugins.features.cnn import CnnOptions

CPU = torch.device("cpu")


def test_last_layers_are_those_of_the_weights() -> None:
    _, head, classes = load_classifier(find_weights(), len(BLOCKS) - 1, CPU)
    state = torch.load(find_weights(), weights_only=True)
    x = torch.randn(2, 320, 3, 4, generator=torch.Generator().manual_seed(0))
    seen = F.batch_norm(
        F.conv2d(x, state["_conv_head.weight"]),
        state["_bn1.running_mean"], state["_bn1.running_var"],
        state["_bn1.weight"], state["_bn1.bias"], eps=1e-3,
    )  # fmt: skip
    assert torch.allclose(head(x), seen, atol=1e-4)
    logits = F.linear(seen.movedim(1, -1), state["_fc.weight"], state["_fc.bias"])
    assert torch.allclose(classes(seen), logits.movedim(-1, 1), atol=1e-3)


def test_classes_are_each_named_once() -> None:
    assert len(set(MOVABLE)) == len(MOVABLE)
    assert min(MOVABLE) == 0 and max(MOVABLE) < 1000
    # Arabian camel, sports car, jersey move; desk, sliding door, lakeside do not.
    assert {354, 817, 610} <= set(MOVABLE) and not {526, 799, 975} & set(MOVABLE)


def test_a_number_from_0_to_1_for_each_cell_of_any_grid() -> None:
    extractor = CnnFeatures(CnnOptions(), BuildContext(CPU))
    image = torch.rand(3, 100, 136, generator=torch.Generator().manual_seed(1))
    for grid in (Grid(12, 17, 8, 3.5), Grid(25, 34, 4, 1.5)):
        p = extractor.movable(image, grid)
        assert p.shape == (grid.height, grid.width)
        assert 0 <= float(p.min()) < float(p.max()) <= 1
        assert torch.equal(p, extractor.movable(image, grid))
    tiny = extractor.movable(image[:, :24, :24], Grid(3, 3, 8, 3.5))
    assert bool(torch.isfinite(tiny).all())


def test_the_largest_answer_of_several_sizes_counts() -> None:
    image = torch.rand(3, 96, 128, generator=torch.Generator().manual_seed(2))
    grid = Grid(12, 16, 8, 3.5)

    def at(*scales: float) -> torch.Tensor:
        options = CnnOptions(movable_scales=list(scales))
        return CnnFeatures(options, BuildContext(CPU)).movable(image, grid)

    one, two = at(1.0), at(2.0)
    assert not torch.equal(one, two)
    assert torch.equal(at(1.0, 2.0), torch.maximum(one, two))


def test_what_says_nothing_is_no_evidence() -> None:
    blank, grid = torch.full((3, 96, 128), 0.6), Grid(12, 16, 8, 3.5)

    def at(evidence: Literal["information", "probability"]) -> torch.Tensor:
        return CnnFeatures(CnnOptions(movable_evidence=evidence), BuildContext(CPU)).movable(
            blank, grid
        )

    assert float(at("information").max()) < 0.1
    assert float(at("probability").max()) > 0.2


def test_evidence_is_the_information_of_the_classes_that_move() -> None:
    classifier = MovableClassifier(find_weights(), CPU, (1.0,), information=True)
    p = torch.full((1, 1000, 1, 3), 1e-9)
    p[0, :, 0, 0] = 1e-3  # anything
    p[0, 354, 0, 1] = 1.0  # a camel
    p[0, 526, 0, 2] = 1.0  # a desk
    found = classifier._evidence((p / p.sum(1, keepdim=True)).log())
    assert torch.allclose(found, torch.tensor([0.0, 1.0, 0.0]).view(1, 1, 1, 3), atol=1e-5)


@pytest.mark.parametrize("scales", [[], [0.0], [1.0, 9.0]])
def test_sizes_that_make_no_picture_are_refused(scales: list[float]) -> None:
    with pytest.raises(ConfigError, match="movable_scales"):
        CnnFeatures(CnnOptions(movable_scales=scales), BuildContext(CPU))


@pytest.mark.parametrize(
    ("size", "grid"),
    [
        ((96, 128), Grid(12, 16, 8, 3.5)),
        ((96, 128), Grid(12, 16, 8, 0.0)),  # as correspondence `droid` has it
        ((100, 140), Grid(6, 9, 16, 7.5)),  # with pixels left over
    ],
)
def test_cells_are_where_the_grid_puts_them(monkeypatch, size, grid) -> None:
    classifier = MovableClassifier(find_weights(), CPU, (1.0,), information=True)

    def where(log_p: torch.Tensor) -> torch.Tensor:
        """Instead of evidence, the column of the picture that each place lies at."""
        height, width = log_p.shape[2:]
        column = (torch.arange(width) + 0.5) * size[1] / width - 0.5
        return column.expand(1, 1, height, width)

    monkeypatch.setattr(classifier, "_evidence", where)
    found = classifier(torch.zeros(3, *size), grid)
    column = torch.arange(grid.width) * grid.stride + grid.offset
    inner = (column > 16) & (column < size[1] - 17)  # beyond, the outermost places are continued
    gap = (found - column)[:, inner].abs()
    assert float(gap.max()) < 1e-3
