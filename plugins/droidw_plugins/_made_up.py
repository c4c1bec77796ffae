"""Weights made up by a rule, for tests and benchmarks: they cost the same time and track nothing.

Nothing that was trained is needed to see that a network runs on a device, how long it takes and how
much memory it wants. A tensor depends on its key and shape alone, and is of a size that keeps
signals at about theirs.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor

__all__ = ["made_up_state", "write_made_up"]

_HEADS = ("update.delta.2.", "update.weight.2.")


def made_up_state(name: str) -> dict[str, Tensor]:
    """Tensors of every key of the weights `name`, in the form in which they are published.

    Args:
        name: droid, fit3d, fit3d-plain, dinov2-vits14, dinov2-vits14-reg, metric3d-vit-small or
            metric3d-vit-large.
    Raises:
        KeyError: there are no such weights.
    """
    state = {key: _drawn(key, shape) for key, shape in _shapes(name).items()}
    if name != "droid":
        return state
    # The published file has a third output in both heads, and was trained on several cards.
    return {
        "module." + key: torch.cat([value, value[:1]]) if key.startswith(_HEADS) else value
        for key, value in state.items()
    }


def write_made_up(folder: Path, names: Iterable[str]) -> Path:
    """Write `folder/NAME.pth` for each name; returns the folder, fit for `DROIDW_WEIGHTS`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        torch.save(made_up_state(name), folder / f"{name}.pth")
    return folder


def _shapes(name: str) -> dict[str, tuple[int, ...]]:
    from droidw_plugins._vit.published import FORMS, transformer_shapes
    from droidw_plugins.correspondence._droid_state import expected_shapes
    from droidw_plugins.depth._metric3d_net import published_shapes

    if name == "droid":
        return expected_shapes()
    if name.startswith("metric3d-"):
        return published_shapes(name.removeprefix("metric3d-"))
    return transformer_shapes(*FORMS[name])


def _drawn(key: str, shape: tuple[int, ...]) -> Tensor:
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(zlib.crc32(key.encode())))
    if key.endswith(".gamma"):
        return 0.1 + 0.02 * noise
    if len(shape) == 1:
        return 0.05 * noise + float(key.endswith(".weight") and "norm" in key)
    made: Tensor = noise * (2.0 / max(math.prod(shape[1:]), 1)) ** 0.5
    return made
