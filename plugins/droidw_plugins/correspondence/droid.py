"""Correspondence `droid`: the recurrent network of DROID-SLAM, which the paper builds on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from droidw.interfaces.correspondence import Correspondence
from droidw.plugin.component import BuildContext, Component
from droidw_plugins._weights import DROID

__all__ = ["COMPONENT", "DroidOptions"]


@dataclass(frozen=True)
class DroidOptions:
    """Options of correspondence `droid`."""

    correlation: Literal["auto", "volume", "lowmem"] = field(
        default="auto",
        metadata={
            "help": "volume: correlation of an edge is kept; lowmem: computed at every update; "
            "auto: kept in the window and for filling while `volume_mb` lasts"
        },
    )
    volume_mb: int = field(
        default=3000, metadata={"help": "memory for kept correlation with `auto`", "ge": 0}
    )
    precision: Literal["auto", "float32", "bfloat16", "float16"] = field(
        default="auto",
        metadata={"help": "of the network; auto: float32 on a CPU, mixed float16 on a GPU"},
    )
    store: Literal["half", "float"] = field(
        default="half",
        metadata={"help": "precision of what is kept of keyframes, edges and correlation"},
    )


def _build(options: Any, context: BuildContext) -> Correspondence:
    from droidw.io.weights import load_state
    from droidw_plugins.correspondence._droid import DroidCorrespondence
    from droidw_plugins.correspondence._droid_net import DroidNet

    net = DroidNet.from_state(load_state(context.weights_dir, DROID), context.device)
    return DroidCorrespondence(net, options, context.device, "droid-w" in context.compat)


COMPONENT: Component[Correspondence] = Component(
    name="droid",
    summary="recurrent dense correspondence of DROID-SLAM, with learned confidence and damping",
    factory=_build,
    options=DroidOptions,
    weights=(DROID,),
    capabilities=frozenset({"cpu", "cuda", "gpu-threads"}),
    reference="Teed and Deng, DROID-SLAM: Deep Visual SLAM for Monocular, Stereo, and RGB-D "
    "Cameras, NeurIPS 2021; weights: see droidw weights list",
)
