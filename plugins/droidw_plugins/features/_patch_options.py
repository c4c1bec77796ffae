"""Options of the feature extractors that are transformers; imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

__all__ = ["PatchOptions"]


@dataclass(frozen=True)
class PatchOptions:
    """Options of `fit3d` and `dinov2`; the defaults are what the published system does."""

    long_side: int = field(
        default=0,
        metadata={
            "help": "longer side of the picture that the network sees, in pixels; each side is "
            "rounded down to a multiple of 14 (0: that of the working picture)",
            "ge": 0,
        },
    )
    precision: Literal["auto", "float32", "bfloat16", "float16"] = field(
        default="auto",
        metadata={
            "help": "of matrix products; auto: float16 on a GPU, float32 on a CPU, which knows "
            "no float16"
        },
    )
    dtype: Literal["float16", "float32"] = field(
        default="float16", metadata={"help": "type in which features are handed over and kept"}
    )
    calibration: Literal["none", "picture"] = field(
        default="none",
        metadata={
            "help": "none: features as published (weighting.similarity brings their cosine to "
            "scale); picture: whitened by mean and spread of the first picture that is not blank"
        },
    )
    shrinkage: float = field(
        default=0.3,
        metadata={
            "help": "share of each channel's own spread that is added before whitening; only "
            "with calibration=picture",
            "gt": 0,
        },
    )
    constant: float = field(
        default=1.0,
        metadata={
            "help": "a channel of this value beside features of length 1; raises cosines; only "
            "with calibration=picture",
            "ge": 0,
        },
    )
    weights: str | None = field(
        default=None,
        metadata={"help": "path of a checkpoint (none: the one that droidw weights fetched)"},
    )
