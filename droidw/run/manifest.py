"""The manifest: what a run was made with, as JSON."""

from __future__ import annotations

import platform
import resource
import sys
from importlib import metadata
from typing import TYPE_CHECKING, Any

import torch

import droidw

if TYPE_CHECKING:
    from droidw.config.resolve import ResolvedConfig

__all__ = ["describe_parts", "peak_memory_mb", "versions"]

_PACKAGES = ("torch", "numpy", "opencv-python-headless", "kornia", "omegaconf", "pluggy", "av")


def versions(device: torch.device) -> dict[str, str]:
    """Versions of what the numbers depend on, and the device."""
    found = {"droidw": droidw.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    found["platform"] = platform.platform()
    if device.type == "cuda":
        found["device"] = torch.cuda.get_device_name(device)
    else:
        found["device"] = f"CPU, {torch.get_num_threads()} threads"
    return found


def describe_parts(resolved: ResolvedConfig) -> dict[str, dict[str, Any]]:
    """Slot -> name, where it comes from, and its reference."""
    described = {}
    for slot, (component, _) in resolved.parts.items():
        entry = resolved.origins.get(slot)
        described[slot] = {
            "name": component.name,
            "from": entry.origin if entry else "",
            "reference": component.reference,
        }
    return described


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, in MB (10^6 bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Linux counts kibibytes, macOS bytes.
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
