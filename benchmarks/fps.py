"""Frames per second of a whole preset at a given size, with weights made up by a rule.

Made-up weights cost what trained ones cost and track nothing, so that how often there is a keyframe
cannot be left to them: it is every `--every` frames, and none is dropped. The clip is rendered.

    python benchmarks/fps.py [--device cuda] [--size 512x384] [--frames 120] [--every 9]
                             [--repeats 2] [--small] [--preset paper] [key=value ...] [--save]

The first run compiles kernels and warms up; it is not counted. `--small` takes the small depth
network with a small input instead of the published one.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from droidw.cli.main import main as droidw
from droidw.testing.scenes import Scene, SceneSpec
from droidw_plugins._made_up import write_made_up

RESULTS = Path(__file__).resolve().parent / "results"
SMALL = "depth.options={variant: vit-small, size: [112, 140]}"


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Runs the benchmark; returns what was measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="as of droidw run")
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda")
    parser.add_argument("--size", default="512x384", help="of the pictures (512x384)")
    parser.add_argument("--frames", type=int, default=120, help="of the clip (120)")
    parser.add_argument("--every", type=int, default=9, help="frames from keyframe to keyframe (9)")
    parser.add_argument("--repeats", type=int, default=2, help="runs that count (2)")
    parser.add_argument("--preset", default="paper", help="paper (default) or droid-slam")
    parser.add_argument("--small", action="store_true", help="the small depth network")
    parser.add_argument("--save", action="store_true", help="write to benchmarks/results too")
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="droidw-fps-") as folder:
        runs = measure(Path(folder), args)
    record = summary(args, runs)
    text = table(record)
    print(text)
    if args.save:
        kind = args.device.partition(":")[0]
        (RESULTS / f"fps_{kind}.json").write_text(json.dumps(record, indent=2) + "\n")
        (RESULTS / f"fps_{kind}.md").write_text(text + "\n")
    return record


def measure(folder: Path, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Manifests of the runs that count."""
    width, height = (int(side) for side in args.size.split("x"))
    clip, weights, out = folder / "clip", folder / "weights", folder / "run"
    Scene(SceneSpec(width=width, height=height, frames=args.frames)).write(clip)
    depth = "metric3d-vit-small" if args.small else "metric3d-vit-large"
    write_made_up(weights, ["droid", "fit3d"] + [depth] * (args.preset == "paper"))
    os.environ["DROIDW_WEIGHTS"] = str(weights)
    command = [
        "run", str(clip), "-o", str(out), "--overwrite", "-q", "--preset", args.preset,
        "--device", args.device, f"camera.size=[{width},{height}]",
        "motion_filter.threshold=1e9", f"motion_filter.force_every={args.every}",
        "exporters={trajectory: {}}", "observers={}",
        *([SMALL] if args.small and args.preset == "paper" else []), *args.overrides,
    ]  # fmt: skip
    found = []
    for _ in range(args.repeats + 1):
        code = droidw(command)
        if code:
            raise SystemExit(f"fps: droidw run ended with exit code {code}")
        found.append(json.loads((out / "manifest.json").read_text()))
    return found[1:]


def summary(args: argparse.Namespace, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """What is written down of the runs: medians, and what they were."""
    names = sorted({name for run in runs for name in run["stages"]})
    return {
        "benchmark": "fps",
        "device": runs[0]["versions"]["device"],
        "machine": platform.machine(),
        "torch": torch.__version__,
        "load": round(os.getloadavg()[0], 1),
        "preset": args.preset,
        "size": args.size,
        "frames": runs[0]["frames"],
        "keyframes": runs[0]["keyframes"],
        "small": args.small,
        "overrides": args.overrides,
        "ba": runs[0]["parts"]["ba"].get("chosen", runs[0]["parts"]["ba"]["name"]),
        "fps": statistics.median(run["fps"] for run in runs),
        "least": min(run["fps"] for run in runs),
        "stages": {
            name: statistics.median(run["stages"].get(name, 0.0) for run in runs) for name in names
        },
    }


def table(record: dict[str, Any]) -> str:
    """The record as Markdown."""
    stages = sorted(record["stages"].items(), key=lambda item: -item[1])
    lines = [
        f"Preset {record['preset']} with made-up weights"
        + (" and the small depth network" if record["small"] else "")
        + f" at {record['size']} on {record['device']}, ba {record['ba']}, torch "
        f"{record['torch']}, load {record['load']}.",
        "",
        f"**{record['fps']:.2f} frames per second** (least {record['least']:.2f}) of "
        f"{record['frames']} frames with {record['keyframes']} keyframes, loading not counted.",
        "",
        "| stage | s |",
        "|---|---|",
        *(f"| {name} | {seconds:.2f} |" for name, seconds in stages),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
