"""Time of one uncertainty update beside one bundle adjustment step, on the same window.

Prints medians of calls made in turn in one process, and their ratio. The first step on given edges
compares features; the second of the two that follow each other in a run may keep that (`refresh`).

    python benchmarks/uncertainty.py [--threads 1] [--repeats 25] [--save] [--json FILE] [--quick]

Steps of `ba=torch` and of `ba=native`, where a compiler is, stand beside; ratios are to the first.
"matched" also finds the scale of similarities (weighting.similarity), as for all features but cnn.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from ba_step import make_window
from end_to_end import RESULTS, machine, today

from droidw.geometry import se3
from droidw.interfaces.uncertainty import UncertaintyModel, UncertaintyView
from droidw.plugin.component import BuildContext
from droidw.solve.problem import BAProblem
from droidw_plugins.bundle import native_ba
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster
from droidw_plugins.uncertainty import affine_softplus, mlp, per_pixel

WINDOWS = ((12, 36), (25, 75), (25, 150))
CHANNELS = 64
DRIFT = 0.002
"""Translation of all cameras between two updates, as late iterations move them (scene units)."""

CPU_PRESET = {"smooth": 1, "residual_gain": 0.35, "residual_majority": 0.6}
CASES = (
    ("affine-softplus", affine_softplus.COMPONENT, {}),
    ("  preset cpu", affine_softplus.COMPONENT, CPU_PRESET),
    ("  matched", affine_softplus.COMPONENT, {"matched": True}),
    ("  tolerance 0.02", affine_softplus.COMPONENT, {"tolerance": 0.02}),
    ("per-pixel", per_pixel.COMPONENT, {}),
    ("mlp", mlp.COMPONENT, {}),
)


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default 1)")
    parser.add_argument("--repeats", type=int, default=25, help="calls per median (default 25)")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument("--save", action="store_true", help="write results/uncertainty.md, .json")
    parser.add_argument("--quick", action="store_true", help="the smallest window only")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    # As in a run, where larger blocks were in use before: memory is not given back in between.
    del_me = torch.ones(7_900_000)
    del del_me
    rows = []
    print(f"30x40 cells, {CHANNELS} channels, {args.threads} threads, processor time, ms")
    print(f"{'keyframes':>9} {'edges':>6} {'model':>17} {'first':>7} {'second':>7} / BA step")
    for keyframes, edges in WINDOWS[:1] if args.quick else WINDOWS:
        for row in measure(keyframes, edges, args.repeats):
            rows.append(row)
            print(
                f"{row['keyframes']:9d} {row['edges']:6d} {row['model']:>17} "
                f"{row['first_ms']:7.2f} {row['second_ms']:7.2f} "
                f"{row['first_over_ba']:4.2f} {row['second_over_ba']:4.2f}",
                flush=True,
            )
    record = {
        "benchmark": "uncertainty",
        "date": today(),
        "torch": torch.__version__,
        **machine(),
        "machine": platform.machine(),
        "threads": args.threads,
        "repeats": args.repeats,
        "rows": rows,
    }
    for path in ([args.json] if args.json else []) + (
        [RESULTS / "uncertainty.json"] if args.save else []
    ):
        path.write_text(json.dumps(record, indent=2) + "\n")
    if args.save:
        (RESULTS / "uncertainty.md").write_text("\n".join(told(record)) + "\n")


def told(record: dict[str, Any]) -> list[str]:
    """The figures as Markdown."""
    return [
        "# One uncertainty update beside one bundle adjustment step",
        "",
        f"{record['date']}, {record['cpu']}, {record['cores']} cores, {record['threads']} thread "
        f"used, no GPU; torch {record['torch']}; load {record['load_average_1min']}; commit "
        f"{record['commit']}. Made by `python benchmarks/uncertainty.py --save`: median of "
        f"{record['repeats']} calls in turn, milliseconds of processor time, 30x40 cells, "
        f"{CHANNELS} channels; in brackets, over that of the step of `ba=torch`.",
        "",
        "| keyframes | edges | step: torch | native | model | first | second |",
        "|---:|---:|---:|---:|---|---|---|",
        *(
            f"| {r['keyframes']} | {r['edges']} | {r['ba_ms']:.1f} | "
            f"{r['native_ms'] or math.nan:.1f} | {r['model'].strip()} | "
            f"{r['first_ms']:.1f} ({r['first_over_ba']:.2f}) | "
            f"{r['second_ms']:.1f} ({r['second_over_ba']:.2f}) |"
            for r in record["rows"]
        ),
    ]


def measure(keyframes: int, edges: int, repeats: int) -> list[dict[str, object]]:
    """All models and the bundle adjuster in turn on one window; medians."""
    problem = make_window(keyframes, edges, 30, 40, torch.float32)
    adjuster = TorchBundleAdjuster()
    ready = native_ba.COMPONENT.available is None or not native_ba.COMPONENT.available()
    native = native_ba.NativeBundleAdjuster() if ready else None
    models = [prepare(component, options, problem) for _, component, options in CASES]
    step: list[float] = []
    compiled: list[float] = []
    first: list[list[float]] = [[] for _ in CASES]
    second: list[list[float]] = [[] for _ in CASES]
    for count in range(repeats + 1):
        taken = clock(lambda: adjuster.step(problem))
        if count:  # the first round warms up
            step.append(taken)
        if native is not None:
            taken = clock(lambda: native.step(problem))
            if count:
                compiled.append(taken)
        for n, (model, view) in enumerate(models):
            # Another edge order is another set of edges, so that nothing is kept from before.
            order = torch.arange(edges).roll(count + 1)
            drift = torch.zeros(6)
            drift[0] = DRIFT * (-1) ** count
            moved = dataclasses.replace(
                view,
                ii=view.ii[order],
                jj=view.jj[order],
                T_cw=se3.retract(view.T_cw, drift * torch.arange(keyframes)[:, None] / keyframes),
            )
            one, two = (clock(lambda m=model, v=moved: m.update(v)) for _ in range(2))
            if count:
                first[n].append(one)
                second[n].append(two)
    ba = statistics.median(step)
    return [
        {
            "keyframes": keyframes,
            "edges": edges,
            "model": name,
            "ba_ms": ba,
            "native_ms": statistics.median(compiled) if compiled else None,
            "first_ms": statistics.median(first[n]),
            "second_ms": statistics.median(second[n]),
            "first_over_ba": statistics.median(first[n]) / ba,
            "second_over_ba": statistics.median(second[n]) / ba,
        }
        for n, (name, _, _) in enumerate(CASES)
    ]


def prepare(
    component: object, options: dict[str, object], problem: BAProblem
) -> tuple[UncertaintyModel, UncertaintyView]:
    """A model with `refresh: 2` and a view of the window with smooth random features."""
    options = dict(options)
    matched = bool(options.pop("matched", False))
    model = component.factory(  # type: ignore[attr-defined]
        component.options(refresh=2, **options),  # type: ignore[attr-defined]
        BuildContext(torch.device("cpu")),
    )
    n, h, w = problem.disps.shape
    sizes = {"h": h, "w": w, "c": CHANNELS}
    draw = torch.Generator().manual_seed(0)
    coarse = torch.randn(1, CHANNELS, h // 5, w // 5, generator=draw)
    features = torch.nn.functional.interpolate(coarse, (h, w), mode="bilinear")
    features = features + 0.3 * torch.randn(n, CHANNELS, h, w, generator=draw)
    view = UncertaintyView(
        features=features,
        uncertainty=torch.zeros(n, h, w),
        fields={
            f.name: torch.full(
                (n, *(sizes[s] if isinstance(s, str) else s for s in f.shape)),
                f.fill,
                dtype=getattr(torch, f.dtype),
            )
            for f in model.fields
        },
        T_cw=problem.T_cw,
        disps=problem.disps,
        intrinsics=problem.intrinsics,
        ii=problem.ii,
        jj=problem.jj,
        target=problem.target,
        confidence=problem.weight,
        frames=torch.arange(n),
        calibrate=matched,
    )
    for index in range(n):
        model.append(view, index)
    return model, view


def clock(call: Callable[[], object]) -> float:
    """Milliseconds of processor time of one call."""
    start = time.process_time()
    call()
    return 1e3 * (time.process_time() - start)


if __name__ == "__main__":
    main()
