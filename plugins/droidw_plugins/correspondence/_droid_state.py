"""The published state dict of the DROID network: its keys, its shapes, and what to do with it.

Nothing here needs torch; a "tensor" is anything with a shape that can be sliced.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from droidw.errors import InputError

__all__ = ["check_state", "expected_shapes"]

_HEADS = ("update.delta.2", "update.weight.2")
_SHOWN = 6


def expected_shapes() -> dict[str, tuple[int, ...]]:
    """Key -> shape of all 102 tensors of the network, after trimming (REFERENCE 1.6)."""
    convolutions: dict[str, tuple[int, int, int]] = {}
    for name, out in (("fnet", 128), ("cnet", 256)):
        convolutions[f"{name}.conv1"] = (32, 3, 7)
        before = 32
        for layer, width in (("layer1", 32), ("layer2", 64), ("layer3", 128)):
            convolutions[f"{name}.{layer}.0.conv1"] = (width, before, 3)
            convolutions[f"{name}.{layer}.0.conv2"] = (width, width, 3)
            if before != width:
                convolutions[f"{name}.{layer}.0.downsample.0"] = (width, before, 1)
            convolutions[f"{name}.{layer}.1.conv1"] = (width, width, 3)
            convolutions[f"{name}.{layer}.1.conv2"] = (width, width, 3)
            before = width
        convolutions[f"{name}.conv2"] = (out, 128, 1)
    convolutions |= {
        "update.corr_encoder.0": (128, 196, 1),
        "update.corr_encoder.2": (128, 128, 3),
        "update.flow_encoder.0": (128, 4, 7),
        "update.flow_encoder.2": (64, 128, 3),
        "update.weight.0": (128, 128, 3),
        "update.weight.2": (2, 128, 3),
        "update.delta.0": (128, 128, 3),
        "update.delta.2": (2, 128, 3),
        "update.gru.convz": (128, 448, 3),
        "update.gru.convr": (128, 448, 3),
        "update.gru.convq": (128, 448, 3),
        "update.gru.w": (128, 128, 1),
        "update.gru.convz_glo": (128, 128, 1),
        "update.gru.convr_glo": (128, 128, 1),
        "update.gru.convq_glo": (128, 128, 1),
        "update.agg.conv1": (128, 128, 3),
        "update.agg.conv2": (128, 128, 3),
        "update.agg.eta.0": (1, 128, 3),
        "update.agg.upmask.0": (576, 128, 1),
    }
    shapes: dict[str, tuple[int, ...]] = {}
    for key, (out, into, side) in convolutions.items():
        shapes[f"{key}.weight"] = (out, into, side, side)
        shapes[f"{key}.bias"] = (out,)
    return shapes


def check_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """The tensors as the network takes them, or an error that says exactly what does not fit.

    As the published system loads `droid.pth` (REFERENCE 1.6): "module." is taken out of the keys,
    which a model trained on several cards has, and only the first two output channels of the two
    heads are kept, of which the published file has three.

    Args:
        state: tensors by key, as stored.
    Raises:
        InputError: keys are missing or too many, or a shape differs; names them.
    """
    expected = expected_shapes()
    found: dict[str, Any] = {}
    for key, value in state.items():
        name = key.replace("module.", "")
        if name in found:
            raise InputError(
                f"the weights of the DROID network hold '{name}' twice, with and without 'module.'",
                "valid: the published droid.pth (droidw weights fetch droid)",
            )
        if name.rpartition(".")[0] in _HEADS and len(value.shape) and value.shape[0] > 2:
            value = value[:2]
        found[name] = value
    missing = [key for key in expected if key not in found]
    unknown = [key for key in found if key not in expected]
    shapes = [
        f"'{key}' has shape {list(found[key].shape)}, not {list(shape)}"
        for key, shape in expected.items()
        if key in found and tuple(found[key].shape) != shape
    ]
    said = []
    if missing:
        said.append(f"{len(missing)} of {len(expected)} tensors are missing: {_some(missing)}")
    if unknown:
        said.append(f"{len(unknown)} tensors do not belong to it: {_some(unknown)}")
    if shapes:
        said.append(f"{len(shapes)} tensors have another shape: " + _some(shapes, "; ", bare=True))
    if said:
        raise InputError(
            "these are not the weights of the DROID network: " + said[0],
            "\n".join([*said[1:], "valid: the published droid.pth (droidw weights fetch droid)"]),
        )
    return {key: found[key] for key in expected}


def _some(names: list[str], joint: str = ", ", bare: bool = False) -> str:
    shown = [name if bare else f"'{name}'" for name in names[:_SHOWN]]
    more = len(names) - len(shown)
    return joint.join(shown) + (f" and {more} more" if more else "")
