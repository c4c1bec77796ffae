"""The device of a run, and one order of operations on it."""

from __future__ import annotations

import os
import random
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from droidw.errors import MissingRequirementError

if TYPE_CHECKING:
    from droidw.config.resolve import ResolvedConfig

__all__ = ["run_device", "settle"]


def run_device(resolved: ResolvedConfig) -> torch.device:
    """The device of the run; `auto` takes a GPU if every part makes use of it."""
    wanted = resolved.config.device
    if wanted == "auto":
        usable = resolved.suits_gpu and torch.cuda.is_available()
        return torch.device("cuda" if usable else "cpu")
    device = torch.device(wanted)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise MissingRequirementError(
            f"device={wanted}: no GPU is visible to torch {torch.__version__}",
            "run on the processor with --device cpu; see: droidw doctor",
        )
    return device


def settle(seed: int, threads: int) -> None:
    """One seed, one order of operations: two runs give the same bytes on a CPU."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    # Half of the cores for torch: the other half decodes and searches flow at the same time, and
    # torch's threads wait for each other, which costs far more than they gain on a busy core.
    torch.set_num_threads(max(1, (threads or os.cpu_count() or 1) // 2))
    # What is float32 is float32 on a GPU too: cuDNN rounds it to ten bits of mantissa by default.
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    # OpenCV's own threads make optical flow depend on their number; droidw runs its own.
    cv2.setNumThreads(1)
