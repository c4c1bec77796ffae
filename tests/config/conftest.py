"""A plain set of parts, so that these tests depend on no built-in."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Literal

import pytest

import droidw
from droidw.config.load import load_config
from droidw.config.resolve import resolve


class Side(Enum):
    left = 1
    right = 2


@dataclass(frozen=True)
class LearnOptions:
    """Options of every kind that a plugin may have."""

    lr: float = field(default=0.1, metadata={"help": "step size", "gt": 0, "le": 1})
    mode: Literal["online", "frozen"] = "online"
    taps: tuple[int, ...] = (4,)
    path: Path | None = None
    side: Side = Side.left

    def __post_init__(self) -> None:
        if self.mode == "frozen" and len(self.taps) > 1:
            raise ValueError("mode 'frozen' takes one tap")


@dataclass(frozen=True)
class OtherOptions:
    lr: float = 0.5
    decay: float = 0.0


@dataclass(frozen=True)
class TextOptions:
    binary: bool = True


@dataclass(frozen=True)
class MappedOptions:
    scale: dict[str, float] = field(default_factory=lambda: {"near": 1.0})


@dataclass(frozen=True)
class OddOptions:
    stream: object = field(default=None)
    call: type(print) = print


BOTH = frozenset({"cpu", "cuda"})


def part(name, options=droidw.NoOptions, capabilities=BOTH, **more):
    return droidw.Component(
        name, "", lambda options, context: options, options, capabilities=capabilities, **more
    )


@pytest.fixture
def plugins():
    found = droidw.load_plugins(environ={"DROIDW_LOAD_PLUGINS": ""})
    found._entries.clear()
    found.failures.clear()
    for kind, component in [
        ("features", part("cnn", capabilities=BOTH | {"features"})),
        ("features", part("none")),
        ("depth", part("none")),
        ("depth", part("net", requires=("acme_net",), extra="net")),
        ("uncertainty", part("affine-softplus", LearnOptions, BOTH | {"features"})),
        ("uncertainty", part("mlp", OtherOptions, BOTH | {"features"})),
        ("uncertainty", part("none")),
        ("ba", part("auto")),
        ("ba", part("torch")),
        ("ba", part("cuda", capabilities=frozenset({"cuda"}))),
        ("correspondence", part("flow", capabilities=frozenset({"cpu"}))),
        ("correspondence", part("net")),
        ("reader", part("video")),
        ("reader", part("odd", OddOptions)),
        ("exporter", part("trajectory")),
        ("exporter", part("ply", TextOptions)),
        ("exporter", part("uncertainty")),
        ("exporter", part("depth")),
        ("exporter", part("mapped", MappedOptions)),
        ("observer", part("progress")),
        ("observer", part("report")),
    ]:
        found.add(kind, component)
    return found


@pytest.fixture
def resolved(plugins):
    """Resolve overrides and files against those parts."""

    def run(*overrides, **more):
        return resolve(load_config(overrides=overrides, **more), plugins)

    return run
