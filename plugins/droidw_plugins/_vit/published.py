"""Published checkpoints of the transformers: which tensors they hold, checked strictly.

Three forms are in circulation for the same network: the official one of DINOv2, that of timm in
which FiT3D is published, and the one inside Metric3D. `canonical` brings all to one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from droidw.errors import InputError
from droidw.io.weights import find, load_state, read_state
from droidw.plugin.weights import WeightsFile
from droidw_plugins._vit.layers import build
from droidw_plugins._vit.model import GRID, SMALL, VisionTransformer, VitSpec
from droidw_plugins._weights import DINOV2_VITS14, DINOV2_VITS14_REG, FIT3D, FIT3D_PLAIN

__all__ = [
    "FORMS",
    "blaming",
    "canonical",
    "check_dinov2_vits14",
    "check_dinov2_vits14_reg",
    "check_fit3d",
    "check_fit3d_plain",
    "check_shapes",
    "floats",
    "load_transformer",
    "read_published",
    "transformer_shapes",
]

_SHOWN = 4  # keys named in a message

FORMS: Mapping[str, tuple[VitSpec, str]] = {
    DINOV2_VITS14.name: (replace(SMALL, resampling="scale"), "official"),
    DINOV2_VITS14_REG.name: (replace(SMALL, registers=4), "official"),
    FIT3D.name: (replace(SMALL, registers=4), "timm"),
    FIT3D_PLAIN.name: (SMALL, "timm"),
}
"""Name of the weights -> sizes of the transformer, and form: "official" or "timm"."""


def transformer_shapes(spec: VitSpec, form: str) -> dict[str, tuple[int, ...]]:
    """Every key and shape of a checkpoint in the form "official" or "timm".

    timm drops the mask token, calls the registers `reg_token`, and where there are registers has
    added the class token's position to the class token already.
    """
    with torch.device("meta"):
        inside = VisionTransformer(spec).state_dict()
    shapes = {key: tuple(value.shape) for key, value in inside.items()}
    if form == "official" or not spec.registers:
        shapes["pos_embed"] = (1, 1 + GRID * GRID, spec.width)
    if form == "official":
        shapes["mask_token"] = (1, spec.width)
    elif spec.registers:
        shapes["reg_token"] = shapes.pop("register_tokens")
    return shapes


def canonical(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A checked state of either form as `VisionTransformer` takes it, in float32."""
    found = {key: value.float() for key, value in state.items() if key != "mask_token"}
    if "reg_token" in found:
        found["register_tokens"] = found.pop("reg_token")
    positions = found["pos_embed"]
    if positions.shape[1] == 1 + GRID * GRID:
        found["cls_token"] = found["cls_token"] + positions[:, :1]
        found["pos_embed"] = positions[:, 1:].contiguous()
    return found


def load_transformer(
    record: WeightsFile, state: Mapping[str, Tensor], device: torch.device, dtype: torch.dtype
) -> VisionTransformer:
    """The transformer with the weights of a published checkpoint.

    Args:
        record: of the weights; its name is a key of `FORMS`.
        state: tensors by key, as published.
        device, dtype: see `droidw_plugins._vit.layers.build`.
    Raises:
        InputError: the checkpoint is not that of this network; says what differs.
    """
    checked = _check(record, state)
    with torch.device("meta"):
        network = VisionTransformer(FORMS[record.name][0])
    return build(network, canonical(checked), device, dtype)


def read_published(
    record: WeightsFile, given: str | None, folder: Path | None
) -> tuple[Path, dict[str, Tensor]]:
    """Find and read a checkpoint.

    Args:
        record: of the weights.
        given: path of a file that is to be used instead, or None.
        folder: where weights are kept.
    Returns:
        Its path, and its tensors as they are stored.
    Raises:
        MissingRequirementError: it is not in the folder.
        InputError: it cannot be read.
    """
    if given:
        path = Path(given).expanduser()
        return path, read_state(path)
    return find(folder, record) or Path(record.file), load_state(folder, record)


@contextmanager
def blaming(path: Path) -> Iterator[None]:
    """Inside, an `InputError` about a checkpoint says which file it is about."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error.message}", error.hint) from error


def check_shapes(
    record: WeightsFile,
    state: Mapping[str, Any],
    expected: Mapping[str, tuple[int, ...]],
    optional: Collection[str] = (),
) -> None:
    """Refuse a state that is not exactly of these keys and shapes.

    Args:
        record: of the weights, for the message.
        state: tensors by key.
        expected: shape of every key.
        optional: keys that may be absent.
    Raises:
        InputError: how many tensors are missing, unknown, of another shape or not floating, and
            the first few of each.
    """
    missing = [key for key in expected if key not in state and key not in optional]
    unknown = [key for key in state if key not in expected]
    shapes, kinds = [], []
    for key, due in expected.items():
        value = state.get(key)
        if value is None:
            continue
        if not isinstance(value, Tensor) or not value.is_floating_point():
            kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
            kinds.append(f"'{key}' ({kind})")
        elif tuple(value.shape) != due:
            shapes.append(f"'{key}' is {list(value.shape)} where {list(due)} is due")
    parts = [
        _counted(len(missing), "is missing", "are missing", [f"'{key}'" for key in missing]),
        _counted(len(unknown), "is unknown", "are unknown", [f"'{key}'" for key in unknown]),
        _counted(len(shapes), "has another shape", "have another shape", shapes),
        _counted(len(kinds), "holds no floats", "hold no floats", kinds),
    ]
    said = "; ".join(part for part in parts if part)
    if not said:
        return
    seen = _recognised(state)
    raise InputError(
        f"these are not the weights '{record.name}': of {len(expected)} tensors {said}",
        (f"it looks like {seen}\n" if seen else "")
        + f"expected is {record.file} as published: droidw weights fetch {record.name}",
    )


def floats(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors detached and contiguous, none sharing memory with another."""
    seen: set[int] = set()
    found = {}
    for key, value in state.items():
        value = value.detach().contiguous()
        if value.data_ptr() in seen:
            value = value.clone()
        seen.add(value.data_ptr())
        found[key] = value
    return found


def _check(record: WeightsFile, state: Mapping[str, Any]) -> dict[str, Tensor]:
    check_shapes(record, state, transformer_shapes(*FORMS[record.name]))
    return floats(state)


def check_dinov2_vits14(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """Check a state dict strictly as that of DINOv2 ViT-S/14 and return it.

    Raises:
        InputError: what differs; see `check_shapes`.
    """
    return _check(DINOV2_VITS14, state)


def check_dinov2_vits14_reg(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """The same for DINOv2 ViT-S/14 with registers."""
    return _check(DINOV2_VITS14_REG, state)


def check_fit3d(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """The same for FiT3D's `dinov2_reg_small_fine`, the extractor of the published system."""
    return _check(FIT3D, state)


def check_fit3d_plain(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """The same for FiT3D's `dinov2_small_fine`, without registers."""
    return _check(FIT3D_PLAIN, state)


def _counted(count: int, one: str, many: str, named: list[str]) -> str:
    if not count:
        return ""
    rest = f" and {count - _SHOWN} more" if count > _SHOWN else ""
    return f"{count} {one if count == 1 else many} ({', '.join(named[:_SHOWN])}{rest})"


def _recognised(state: Mapping[str, Any]) -> str:
    """What a state with the wrong keys most likely is, or ""."""
    tests: list[tuple[str, Callable[[str], bool]]] = [
        ("Metric3D v2", lambda key: key.startswith("depth_model.")),
        ("FiT3D or timm with registers ('fit3d')", lambda key: key == "reg_token"),
        ("DINOv2 with registers ('dinov2-vits14-reg')", lambda key: key == "register_tokens"),
        ("DINOv2 without registers ('dinov2-vits14')", lambda key: key == "mask_token"),
        ("FiT3D or timm without registers ('fit3d-plain')", lambda key: key == "pos_embed"),
        ("the DROID network ('droid')", lambda key: key.startswith(("module.fnet.", "fnet."))),
    ]
    return next((what for what, test in tests if any(test(key) for key in state)), "")
