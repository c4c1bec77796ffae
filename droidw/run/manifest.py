"""The manifest: what a run was made with, as JSON."""

from __future__ import annotations

import math
import platform
import resource
import sys
from importlib import metadata
from typing import TYPE_CHECKING, Any

import torch

import droidw
from droidw.errors import InputError
from droidw.io.weights import fingerprint
from droidw.plugin.weights import find_weights, weights_name

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from droidw.config.resolve import ResolvedConfig
    from droidw.interfaces.datasets import FrameSource
    from droidw.slam.doubt import Link
    from droidw.slam.records import Outcome
    from droidw.slam.timing import Stopwatch

__all__ = [
    "describe_parts",
    "facts_of_setup",
    "facts_of_time",
    "facts_of_tracking",
    "peak_memory_mb",
    "told",
    "versions",
]

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


def describe_parts(
    resolved: ResolvedConfig, weights_dir: Path | None = None, parts: object = None
) -> dict[str, dict[str, Any]]:
    """Slot -> name, where it comes from, its reference, and its weights with their hashes.

    Args:
        resolved: the configuration.
        weights_dir: where weights files lie.
        parts: the built parts by slot as attributes; one that found weights of its own says
            their hash as `weights_sha256`, and one that chose among others says it as `chosen`.
    """
    described: dict[str, dict[str, Any]] = {}
    for slot, (component, options) in resolved.parts.items():
        entry = resolved.origins.get(slot)
        described[slot] = {
            "name": component.name,
            "from": entry.origin if entry else "",
            "reference": component.reference,
        }
        weights = {}
        for wanted in component.weights_for(options):
            path = find_weights(weights_dir, wanted)
            if path is not None:
                weights[weights_name(wanted)] = {"file": path.name, "sha256": _hash(path)}
        own = getattr(getattr(parts, slot, None), "weights_sha256", "")
        if own and not weights:
            weights["own"] = {"sha256": str(own)}
        if weights:
            described[slot]["weights"] = weights
        chosen = getattr(getattr(parts, slot, None), "chosen", "")
        if chosen:
            described[slot]["chosen"] = str(chosen)
    return described


def _hash(path: Path) -> str:
    """SHA-256 of a file; "" where it has changed meanwhile, which must not cost the results."""
    try:
        return fingerprint(path)
    except (InputError, OSError):
        return ""


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, in MB (10^6 bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Linux counts kibibytes, macOS bytes.
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


_REPORTS = {
    "rejected": "{count} bundle adjustment steps were rejected, since none lowered the energy",
    "singular": "{count} bundle adjustment steps could not be solved (singular system)",
    "nonfinite": "{count} bundle adjustment steps were not finite and were left out",
    "empty": "{count} bundle adjustment steps had nothing to move",
    "dropped": "{count} measurements that were not finite were left out",
    "uncertainty": "{count} updates of the uncertainty model were not finite",
    "unusable": "{count} cells were left an uncertainty that is negative (taken for 0) or not "
    "finite (left out): the uncertainty model is at fault",
}
"""What the optimiser counts -> the sentence for the user."""


def told(reports: Mapping[str, int]) -> list[str]:
    """A sentence for each status that was counted."""
    return [
        _REPORTS.get(status, "{count} steps: " + status).format(count=count)
        for status, count in reports.items()
    ]


def _facts_of_link(link: Link) -> dict[str, Any] | None:
    """Where the path hangs together least."""
    if math.isnan(link.share):
        return None
    return {"frame": link.frame, "agreement": round(link.share, 4)}


def facts_of_tracking(source: FrameSource, outcome: Outcome) -> dict[str, Any]:
    """How much was read and tracked, and with which working camera."""
    camera, agreement = outcome.camera, outcome.diagnosis.agreement
    return {
        "frames": len(outcome.trajectory),
        "last_frame": outcome.last_index,
        "keyframes": len(outcome.keyframes),
        "agreement": None if math.isnan(agreement) else round(agreement, 4),
        "weakest": _facts_of_link(outcome.diagnosis.weakest),
        "backwards": round(outcome.diagnosis.backwards, 4),
        "skipped": source.skipped,
        "problems": source.problems[:100],
        "intrinsics": {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
        },
        "scale": "metric, from the depth prior" if outcome.metric else "arbitrary",
    }


def facts_of_time(clock: Stopwatch, frames: int, starting: float, elapsed: float) -> dict[str, Any]:
    """Seconds in all and by stage, frames per second without the start, peak memory."""
    stages = {**clock.seconds, "start": starting}
    return {
        "seconds": round(elapsed, 3),
        "fps": round(frames / max(elapsed - starting, 1e-9), 2),
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "stages": {name: round(value, 4) for name, value in stages.items()},
    }


def facts_of_setup(
    resolved: ResolvedConfig,
    device: torch.device,
    weights_dir: Path | None = None,
    parts: object = None,
) -> dict[str, Any]:
    """Configuration, parts and versions; arguments as of `describe_parts`."""
    return {
        "preset": resolved.preset or "",
        "seed": resolved.config.seed,
        "device": str(device),
        "versions": versions(device),
        "parts": describe_parts(resolved, weights_dir, parts),
        "config_yaml": resolved.to_yaml(),
    }
