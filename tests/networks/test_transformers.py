"""Features `fit3d` and `dinov2`: parity with the published networks, sampling, refusals."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from droidw.errors import ConfigError, InputError, MissingRequirementError
from droidw.geometry.camera import Grid
from droidw.plugin.component import BuildContext
from droidw.testing.conformance import check_feature_extractor
from droidw_plugins._vit.layers import choose_dtype, exact
from droidw_plugins._vit.model import VitSpec, resample_positions
from droidw_plugins._vit.published import FORMS, load_transformer, transformer_shapes
from droidw_plugins._weights import DINOV2_VITS14, DINOV2_VITS14_REG, FIT3D, FIT3D_PLAIN
from droidw_plugins.features import dinov2, fit3d
from droidw_plugins.features._patches import PatchFeatures, patch_grid, sample_at_cells

CPU = torch.device("cpu")
LIMIT = 3e-5  # of tokens: ../shared/parity/networks/README.md
KEYS = {
    "dinov2-vits14": "dinov2/keys_vits14.json",
    "dinov2-vits14-reg": "dinov2/keys_vits14_reg4.json",
    "fit3d": "fit3d/keys_dinov2_reg_small_fine.json",
    "fit3d-plain": "fit3d/keys_dinov2_small_fine.json",
}
ARRAYS = {
    "dinov2-vits14": "dinov2/dinov2_vits14.npz",
    "dinov2-vits14-reg": "dinov2/dinov2_vits14_reg4.npz",
    "fit3d": "fit3d/fit3d_dinov2_reg_small_fine.npz",
    "fit3d-plain": "fit3d/fit3d_dinov2_small_fine.npz",
}
COMPONENTS = {
    "dinov2-vits14": (dinov2.COMPONENT, {"variant": "vits14"}),
    "dinov2-vits14-reg": (dinov2.COMPONENT, {}),
    "fit3d": (fit3d.COMPONENT, {}),
    "fit3d-plain": (fit3d.COMPONENT, {"variant": "small"}),
}
RECORDS = {r.name: r for r in (DINOV2_VITS14, DINOV2_VITS14_REG, FIT3D, FIT3D_PLAIN)}


@pytest.fixture(scope="session")
def network(stand_in):
    """name -> transformer with stand-in weights, made once."""
    made = {}

    def build(name):
        if name not in made:
            made[name] = load_transformer(RECORDS[name], stand_in(name), CPU, torch.float32)
        return made[name]

    return build


@pytest.fixture
def extractor(checkpoint):
    def build(name, **options):
        component, chosen = COMPONENTS[name]
        options = component.options(weights=str(checkpoint(name)), **chosen, **options)
        found = component.factory(options, BuildContext(CPU))
        assert isinstance(found, PatchFeatures)
        return found

    return build


def gap(found, expected):
    assert found.shape == expected.shape
    return float((found - expected).abs().max()) if found.numel() else 0.0


@pytest.mark.parametrize("name", KEYS)
def test_keys_are_those_of_the_published_file(name, key_list):
    assert transformer_shapes(*FORMS[name]) == key_list(KEYS[name])


@pytest.mark.parametrize("name", ["dinov2-vits14", "dinov2-vits14-reg"])
@torch.no_grad()
def test_dinov2_gives_the_published_tokens(name, network, parity, normalised):
    expected, net = parity(ARRAYS[name]), network(name)
    positions = net.positions(7, 9)
    assert gap(positions, expected["pos_embed_resized"][:, 1:]) < 5e-6
    x = normalised(expected["image"])
    tokens = net.embed(x)
    for block in net.blocks[:3]:
        tokens = block(tokens)
    prefix = net.spec.prefix
    assert gap(tokens[:, prefix:], expected["block2_patchtokens_unnormed"]) < LIMIT
    tokens = net(x)
    assert gap(tokens[:, 0], expected["x_norm_clstoken"]) < LIMIT
    assert gap(tokens[:, 1:prefix], expected["x_norm_regtokens"]) < LIMIT
    assert gap(tokens[:, prefix:], expected["x_norm_patchtokens"]) < LIMIT


@pytest.mark.parametrize("name", ["fit3d", "fit3d-plain"])
@torch.no_grad()
def test_fit3d_gives_the_published_tokens(name, network, parity, normalised):
    expected, net = parity(ARRAYS[name]), network(name)
    x, prefix = normalised(expected["image"]), net.spec.prefix
    tokens = net.embed(x)
    for block in net.blocks[:9]:
        tokens = block(tokens)
    middle = net.norm(tokens)[:, prefix:].transpose(1, 2).reshape(1, 384, 7, 9)
    assert gap(middle, expected["block8_normed_nchw"]) < LIMIT
    tokens = net(x)
    assert gap(tokens[:, :prefix], expected["x_norm_prefix_tokens"]) < LIMIT
    assert gap(tokens[:, 0], expected["x_norm_clstoken"]) < LIMIT
    assert gap(tokens[:, prefix:], expected["x_norm_patchtokens"]) < LIMIT


@pytest.mark.parametrize("name", ["fit3d", "fit3d-plain"])
def test_the_whole_call_of_the_published_system_at_odd_sizes(name, extractor, parity):
    expected, part = parity(ARRAYS[name]), extractor(name)
    image = expected["image"].permute(2, 0, 1).float() / 255
    assert gap(part.patches(image).permute(1, 2, 0), expected["features_hwc"]) < LIMIT
    odd = expected["odd_image"].permute(2, 0, 1).float() / 255  # 101x131, no multiples of 14
    assert gap(part.network_input(odd), expected["odd_resized_input"]) < 5e-6
    assert gap(part.patches(odd).permute(1, 2, 0), expected["odd_features_hwc"]) < LIMIT


@torch.no_grad()
def test_timm_form_is_the_same_network(network, stand_in):
    """With registers the class token holds its position already, and nothing else differs."""
    official = dict(stand_in("dinov2-vits14-reg"))
    positions = official.pop("pos_embed")
    del official["mask_token"]
    timm = official | {
        "cls_token": official["cls_token"] + positions[:, :1],
        "pos_embed": positions[:, 1:],
        "reg_token": official["register_tokens"],
    }
    del timm["register_tokens"]
    x = torch.randn(1, 3, 28, 70, generator=torch.Generator().manual_seed(1))
    same = load_transformer(FIT3D, timm, CPU, torch.float32)
    assert torch.equal(same(x), network("dinov2-vits14-reg")(x))


def test_positions_are_resampled_as_each_network_was_trained():
    grid = torch.randn(1, 8, 37, 37, generator=torch.Generator().manual_seed(2))
    for how in ("scale", "size"):
        assert torch.equal(resample_positions(grid, 37, 37, how), grid)
        for shape in ((1, 1), (25, 45), (44, 76), (37, 60), (90, 5)):
            assert resample_positions(grid, *shape, how).shape[-2:] == shape
    # Rows are rows: a grid that varies down the picture alone still does.
    down = torch.linspace(0, 1, 37)[:, None].expand(37, 37)[None, None]
    for how in ("scale", "size"):
        found = resample_positions(down, 12, 50, how)[0, 0]
        assert (found - found[:, :1]).abs().max() < 1e-5
        assert (found[1:, 0] > found[:-1, 0]).all()
    assert (
        gap(resample_positions(grid, 20, 30, "scale"), resample_positions(grid, 20, 30, "size"))
        > 0.1
    )


@pytest.mark.parametrize("size", [(384, 512), (101, 131), (360, 640), (48, 64)])
def test_sampling_is_enlarging_and_picking_pixels(size):
    height, width = size
    rows, columns = patch_grid(height, width)
    generator = torch.Generator().manual_seed(3)
    patches = torch.randn(5, rows, columns, generator=generator, dtype=torch.float64)
    large = F.interpolate(patches[None], size=size, mode="bilinear", align_corners=False)[0]
    for stride, pixel in ((8, 3), (8, 0), (4, 2)):  # pixel 3 of 8 is what the published code reads
        grid = Grid.of(height, width, stride, float(pixel))
        expected = large[:, pixel::stride, pixel::stride][:, : grid.height, : grid.width]
        assert gap(sample_at_cells(patches, size, grid), expected) < 1e-12
    # Between two pixels a cell lies between them, and not at one of them.
    grid = Grid.of(height, width, 8, 3.5)
    centres = (grid.centres().double() + 0.5) / torch.tensor([width, height]) * 2 - 1
    expected = F.grid_sample(
        patches[None], centres[None], padding_mode="border", align_corners=False
    )[0]
    assert gap(sample_at_cells(patches, size, grid), expected) < 1e-6


def test_patch_grids():
    assert patch_grid(360, 640) == (25, 45)
    assert patch_grid(14, 27) == (1, 1)
    assert patch_grid(240, 320, 518) == (27, 37)
    assert patch_grid(70, 140, 280) == (10, 20)
    with pytest.raises(InputError, match="13x200 pixels is too small"):
        patch_grid(200, 13)


def test_features_are_handed_over_in_half(extractor):
    image = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(4))
    grid = Grid.of(48, 64, 8, 3.5)
    half, full = extractor("fit3d"), extractor("fit3d", dtype="float32")
    found, expected = half.extract(image, grid), full.extract(image, grid)
    assert (half.dim, half.dtype, found.dtype) == (384, torch.float16, torch.float16)
    assert expected.dtype == torch.float32 and found.shape == (384, 6, 8)
    assert torch.equal(found, expected.half())
    assert not torch.allclose(expected.norm(dim=0), torch.ones(6, 8))  # raw, as published


def test_bfloat16_products_and_larger_inputs(extractor):
    image = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(5))
    grid = Grid.of(48, 64, 8, 3.5)
    sharp = extractor("dinov2-vits14", dtype="float32").extract(image, grid)
    rough = extractor("dinov2-vits14", dtype="float32", precision="bfloat16").extract(image, grid)
    assert 0 < gap(rough, sharp) < 0.2
    assert F.cosine_similarity(rough, sharp, dim=0).min() > 0.999
    fine = extractor("dinov2-vits14", long_side=112)
    assert fine.patches(image).shape == (384, 6, 8)


def test_calibration_from_the_first_picture(extractor):
    grid = Grid.of(112, 140, 8, 3.5)
    picture = torch.rand(3, 112, 140, generator=torch.Generator().manual_seed(6))
    part = extractor("fit3d", calibration="picture", dtype="float32")
    nothing = part.extract(torch.full_like(picture, 0.5), grid)
    assert part.state_dict() == {}  # nothing is learned from a blank picture
    found = part.extract(picture, grid)
    # and it is neither like nor unlike what comes later
    cosine = F.cosine_similarity(nothing, found, dim=0)
    assert nothing.shape == found.shape and float(cosine.std()) < 0.1 and cosine.min() > 0.5
    assert part.dim == found.shape[0] == 385
    assert torch.allclose(found.norm(dim=0), torch.ones(grid.height, grid.width), atol=1e-4)
    other = extractor("fit3d", calibration="picture", dtype="float32")
    other.load_state_dict(part.state_dict())
    assert torch.equal(other.extract(picture, grid), found)


@pytest.mark.parametrize("name", ["fit3d", "dinov2-vits14"])
def test_contract(name, checkpoint, device):
    component, chosen = COMPONENTS[name]
    options = component.options(weights=str(checkpoint(name)), **chosen)
    check_feature_extractor(component, device, options)


def test_weights_follow_the_options(checkpoint, tmp_path):
    for name, (component, chosen) in COMPONENTS.items():
        assert component.weights_for(component.options(**chosen)) == (RECORDS[name],)
        given = component.options(weights="somewhere.pth", **chosen)
        assert component.weights_for(given) == ()
    with pytest.raises(MissingRequirementError, match="weights 'fit3d' are not in"):
        fit3d.COMPONENT.factory(fit3d.Fit3dOptions(), BuildContext(CPU, weights_dir=tmp_path))
    (tmp_path / "fit3d.pth").symlink_to(checkpoint("fit3d"))
    part = fit3d.COMPONENT.factory(fit3d.Fit3dOptions(), BuildContext(CPU, weights_dir=tmp_path))
    assert part.dim == 384


def test_refusals(extractor, checkpoint, tmp_path):
    with pytest.raises(ConfigError, match=r"features\.options\.precision: float16 needs a GPU"):
        extractor("fit3d", precision="float16")
    with pytest.raises(InputError, match="64x12 pixels is too small for patches of 14x14"):
        extractor("fit3d").extract(torch.zeros(3, 12, 64), Grid(1, 8, 8, 3.5))

    def load(path, variant="reg-small"):
        options = fit3d.Fit3dOptions(weights=str(path), variant=variant)
        fit3d.COMPONENT.factory(options, BuildContext(CPU))

    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path / "none.pth")
    whole = checkpoint("fit3d").read_bytes()
    (tmp_path / "cut.pth").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="cut short"):
        load(tmp_path / "cut.pth")
    with pytest.raises(InputError) as caught:
        load(checkpoint("dinov2-vits14-reg"))
    said = str(caught.value)
    assert "dinov2-vits14-reg.pth: these are not the weights 'fit3d'" in said
    assert "1 is missing ('reg_token')" in said
    assert "2 are unknown ('" in said and "'register_tokens'" in said and "'mask_token'" in said
    assert "'pos_embed' is [1, 1370, 384] where [1, 1369, 384] is due" in said
    assert "it looks like DINOv2 with registers ('dinov2-vits14-reg')" in said
    with pytest.raises(InputError, match=r"looks like FiT3D or timm with registers \('fit3d'\)"):
        load(checkpoint("fit3d"), "small")


def test_what_differs_is_counted(stand_in):
    state = dict(stand_in("fit3d"))
    for index in range(5):
        del state[f"blocks.{index}.norm1.bias"]
    state["norm.weight"] = torch.zeros(384, dtype=torch.int64)
    with pytest.raises(InputError) as caught:
        load_transformer(FIT3D, state, CPU, torch.float32)
    assert "of 175 tensors 5 are missing ('blocks.0.norm1.bias', " in caught.value.message
    assert "and 1 more" in caught.value.message
    assert "1 holds no floats ('norm.weight' (torch.int64))" in caught.value.message
    assert "droidw weights fetch fit3d" in caught.value.hint


def test_float32_on_a_gpu_is_float32_and_nothing_stays_changed():
    cudnn = torch.backends.cudnn
    before = cudnn.enabled, cudnn.benchmark, cudnn.deterministic, cudnn.allow_tf32
    with exact(torch.float32, torch.device("cuda")):
        assert not cudnn.allow_tf32
        assert (cudnn.enabled, cudnn.benchmark, cudnn.deterministic) == before[:3]
    for dtype, device in ((torch.float16, "cuda"), (torch.float32, "cpu")):
        with exact(dtype, torch.device(device)):
            assert cudnn.allow_tf32 == before[3]
    assert (cudnn.enabled, cudnn.benchmark, cudnn.deterministic, cudnn.allow_tf32) == before
    assert choose_dtype("auto", torch.device("cuda"), "key") == torch.float16
    assert choose_dtype("auto", CPU, "key") == torch.float32


def test_prefix_counts_class_and_registers():
    assert VitSpec(384, 12, 6).prefix == 1
    assert VitSpec(384, 12, 6, registers=4).prefix == 5
