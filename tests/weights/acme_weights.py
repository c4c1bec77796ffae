"""A stranger's plugin with weights of its own; the tests hand it to `--plugin`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

import droidw
from droidw.errors import InputError

SHAPES = {"conv.weight": (4, 3, 3, 3), "conv.bias": (4,), "alias.bias": (4,)}


def check(state):
    from droidw.io.weights_store import require_shapes

    return require_shapes(state, SHAPES, optional=["alias.bias"])


def check_big(state):
    if set(state) != {"big"}:
        raise InputError("the one tensor 'big' is not alone")
    return state


SMALL = droidw.WeightsFile(
    name="acme-small",
    urls=(os.environ.get("ACME_URL", "http://127.0.0.1:9") + "/acme_v2.pth",),
    size=1000,
    licence="CC BY-NC 4.0",
    file="acme_v2.pth",
    check=check,
    reference="acme.example",
)
BIG = droidw.WeightsFile(name="acme-big", check=check_big)


@dataclass(frozen=True)
class Options:
    size: Literal["small", "big"] = "small"


def _build(options, context):
    raise AssertionError("these tests build no part")


@droidw.hookimpl
def droidw_depth_priors():
    yield droidw.Component(
        name="acme",
        summary="a depth network",
        factory=_build,
        options=Options,
        weights=lambda options: (SMALL if options.size == "small" else BIG,),
    )
