"""Options that readers of datasets with true poses share."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

__all__ = ["PosedOptions"]


@dataclass(frozen=True)
class PosedOptions:
    """How a picture finds its true pose."""

    max_difference: float = field(
        default=0.02,
        metadata={"help": "largest time between a picture and its true pose, in s", "gt": 0},
    )

    def __post_init__(self) -> None:
        if not (math.isfinite(self.max_difference) and self.max_difference > 0):
            raise ValueError(f"max_difference must be positive, not {self.max_difference}")
