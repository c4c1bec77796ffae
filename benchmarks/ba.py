"""Time and memory of one bundle adjustment step: torch and compiled kernels, on CPU and GPU.

Every backend takes the same windows in turn, in one process, so that all see the same machine;
memory is what a process of its own grows by. With one thread the time on a CPU is processor time,
which other programs disturb less. The floor is the larger of two times: the bytes that must be
moved at least over the measured speed of memory, and the operations over the measured speed of a
matrix product (float32).

    python benchmarks/ba.py [--threads 1] [--repeats 9] [--most 1000] [--quick] [--save]
                            [--only "torch GPU,cuda"]

`--save` writes after every window, so that nothing measured is lost where the time runs out.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from ba_step import make_window

from droidw.errors import DroidwError
from droidw.interfaces.bundle import BundleAdjuster
from droidw.plugin.component import BuildContext
from droidw.solve.problem import BAProblem
from droidw_plugins.bundle import cuda_ba, native_ba, torch_ba

WINDOWS = ((12, 36), (25, 75), (60, 180), (350, 2100), (1000, 6000))
GRIDS = ((48, 64), (45, 80))
RESULTS = Path(__file__).resolve().parent / "results"

BACKENDS = {
    "torch CPU": (torch_ba.COMPONENT, "cpu"),
    "native CPU": (native_ba.COMPONENT, "cpu"),
    "torch GPU": (torch_ba.COMPONENT, "cuda"),
    "cuda": (cuda_ba.COMPONENT, "cuda"),
}

# Operations per cell (additions and multiplications each count as one), from csrc/cell.h.
EDGE_FLOPS = 45 + 90 + 22 + 12  # projection and residual; pose sums; E; C and w
BACK_FLOPS = 45 + 40  # projection again, and the product with the pose steps
PAIR_FLOPS = 72
EDGE_BYTES, FRAME_BYTES = 16, 12  # target and weight; disparity, damping, result


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1, help="threads on the CPU (default 1)")
    parser.add_argument("--repeats", type=int, default=9, help="steps per median (default 9)")
    parser.add_argument("--most", type=int, default=1000, help="no windows of more keyframes")
    parser.add_argument("--huber", type=float, default=0.0, help="Huber threshold (0: none)")
    parser.add_argument(
        "--cross", action="store_true", help="weights with an off-diagonal: three channels"
    )
    parser.add_argument("--quick", action="store_true", help="the smallest window only")
    parser.add_argument("--only", default="", help="these backends: " + ", ".join(BACKENDS))
    parser.add_argument(
        "--save", action="store_true", help="write results/ba.json and ba.md (ba_cuda with a GPU)"
    )
    parser.add_argument("--memory-of", nargs=5, help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.memory_of:
        sys.stdout.write(json.dumps(memory_of(*args.memory_of)))
        return
    wanted = [name.strip() for name in args.only.split(",") if name.strip()] or list(BACKENDS)
    if unknown := set(wanted) - set(BACKENDS):
        parser.error(f"--only: no backend {sorted(unknown)}; there are {', '.join(BACKENDS)}")
    built = {name: made for name in wanted if (made := build(name)) is not None}
    speeds = {device: ceilings(device) for device in {BACKENDS[name][1] for name in built}}
    windows = [w for w in WINDOWS if w[0] <= args.most][: 1 if args.quick else None]
    record: dict[str, Any] = {
        "benchmark": "ba",
        "machine": facts(args.threads),
        "repeats": args.repeats,
        "huber": args.huber,
        "cross": args.cross,
        "ceilings": speeds,
        "rows": [],
    }
    for h, w in GRIDS[:1] if args.quick else GRIDS:
        for keyframes, edges in windows:
            problem = window(keyframes, edges, h, w, args.huber, args.cross)
            row = measure(built, speeds, problem, args.repeats)
            record["rows"].append(row)
            record["machine"]["load"] = os.getloadavg()[0]
            print(line(row), flush=True)
            if args.save:
                save(record)
    print(table(record))


def save(record: dict[str, Any]) -> None:
    """Keep what is measured so far in `results/`."""
    RESULTS.mkdir(exist_ok=True)
    name = "ba" if record["machine"]["gpu"] == "none" else "ba_cuda"
    (RESULTS / f"{name}.json").write_text(json.dumps(record, indent=2) + "\n")
    (RESULTS / f"{name}.md").write_text(table(record))


def build(name: str) -> BundleAdjuster | None:
    """The backend, or None where it cannot run; says why."""
    component, device = BACKENDS[name]
    if device == "cuda" and not torch.cuda.is_available():
        print(f"{name}: no GPU here, not measured")
        return None
    try:
        return component.factory(component.options(), BuildContext(device=torch.device(device)))
    except DroidwError as error:
        print(f"{name}: not measured: {error}")
        return None


def window(
    keyframes: int, edges: int, h: int, w: int, huber: float = 0.0, cross: bool = False
) -> BAProblem:
    """A window of `ba_step`, in float32 on the CPU."""
    p = replace(make_window(keyframes, edges, h, w, torch.float32), huber=huber or None)
    if not cross:
        return p
    tilt = 2 * torch.rand(p.weight.shape[:3], generator=torch.Generator().manual_seed(1)) - 1
    off = tilt * p.weight.prod(-1).sqrt()
    return replace(p, weight=torch.cat((p.weight, off[..., None]), dim=-1))


def on(device: str, p: BAProblem) -> BAProblem:
    """The same problem on a device."""
    moved = {k: v.to(device) for k, v in vars(p).items() if isinstance(v, torch.Tensor)}
    return replace(p, **moved)


def measure(
    built: dict[str, BundleAdjuster],
    speeds: dict[str, dict[str, float]],
    problem: BAProblem,
    repeats: int,
) -> dict[str, Any]:
    """One row: milliseconds (median, least), memory, and floors of every backend."""
    keyframes, h, w = problem.disps.shape
    edges = len(problem.ii)
    problems = {device: on(device, problem) for device in {BACKENDS[name][1] for name in built}}
    times: dict[str, list[float]] = {name: [] for name in built}
    repeats = repeats if edges < 1000 else max(3, repeats // 3)
    for turn in range(repeats + 1):
        for name, adjuster in built.items():
            spent = timed(adjuster, problems[BACKENDS[name][1]])
            if turn:  # the first call warms up
                times[name].append(spent)
    counted = work(problem)
    row: dict[str, Any] = {
        "keyframes": keyframes, "edges": edges, "grid": f"{h}x{w}", **counted, "backends": {}
    }  # fmt: skip
    for name in built:
        device = BACKENDS[name][1]
        speed = speeds[device]
        size = [str(x) for x in (keyframes, edges, h, w)]
        row["backends"][name] = {
            "ms": statistics.median(times[name]),
            "least_ms": min(times[name]),
            "memory_mb": json.loads(child("--memory-of", name, *size)),
            "floor_ms": 1e3 * max(
                counted["bytes"] / speed["bytes_per_s"], counted["flops"] / speed["flops_per_s"]
            ),
        }  # fmt: skip
    return row


def timed(adjuster: BundleAdjuster, problem: BAProblem) -> float:
    """Milliseconds of a step, what the device has yet to do included."""
    clock = clock_for(problem.disps.device.type)
    start = clock()
    step = adjuster.step(problem)
    if problem.disps.is_cuda:
        torch.cuda.synchronize()
    spent = 1e3 * (clock() - start)
    if step.report.status != "ok":
        raise SystemExit(f"a step ended with '{step.report.status}': nothing was measured")
    return spent


def work(p: BAProblem) -> dict[str, float]:
    """Bytes that a step must move and operations that it must do."""
    n, h, w = p.disps.shape
    edges = p.ii.shape[0]
    degree = torch.bincount(p.ii)
    pairs = float((degree * (degree + 1) // 2).sum())
    cells = h * w
    return {
        "bytes": float(cells * (edges * (EDGE_BYTES + 4 * (p.channels - 2)) + n * FRAME_BYTES)),
        "flops": cells * (edges * (EDGE_FLOPS + BACK_FLOPS) + pairs * PAIR_FLOPS),
    }


def ceilings(device: str) -> dict[str, float]:
    """Bytes per second of a large copy and operations per second of a large product, measured."""
    size = 1 << (28 if device == "cuda" else 25)
    a = torch.ones(size // 4, device=device)
    b = torch.empty_like(a)
    n = 8192 if device == "cuda" else 1024
    m = torch.randn(n, n, device=device)
    out = torch.empty_like(m)
    torch.backends.cuda.matmul.allow_tf32 = False
    copy = best(lambda: b.copy_(a), device)
    product = best(lambda: torch.mm(m, m, out=out), device)
    return {"bytes_per_s": 2 * size / copy, "flops_per_s": 2 * n**3 / product}


def best(call: Callable[[], Any], device: str) -> float:
    """Least seconds of several calls."""
    least = float("inf")
    clock = clock_for(device)
    for _ in range(25):
        start = clock()
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        least = min(least, clock() - start)
    return least


def clock_for(device: str) -> Callable[[], float]:
    """Processor time where one thread does all the work, else time on the wall."""
    alone = device == "cpu" and torch.get_num_threads() == 1
    return time.process_time if alone else time.perf_counter


def memory_of(name: str, *size: str) -> float:
    """MB (10^6 bytes) that three steps add to a process, beyond the problem itself."""
    component, device = BACKENDS[name]
    adjuster = component.factory(component.options(), BuildContext(device=torch.device(device)))
    adjuster.step(on(device, window(2, 2, 3, 4)))  # libraries that load at first use
    p = on(device, window(*(int(x) for x in size)))  # type: ignore[arg-type]
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = float(torch.cuda.memory_allocated())
    else:
        # what makes the window may have needed more than it holds
        ballast = torch.ones(max(0, int(peak() - resident())) // 4)
        before = peak()
    for _ in range(3):
        adjuster.step(p)
    after = float(torch.cuda.max_memory_allocated()) if device == "cuda" else peak()
    if device != "cuda":
        del ballast
    return (after - before) / 1e6


def peak() -> float:
    """Largest resident size of this process so far, bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(most if sys.platform == "darwin" else most * 1024)


def resident() -> float:
    """Resident size of this process, bytes; the peak where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return peak()
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


def child(*arguments: str) -> str:
    """What this script prints with other arguments."""
    done = subprocess.run(
        [sys.executable, __file__, *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout.splitlines()[-1]


def facts(threads: int) -> dict[str, Any]:
    """What the figures depend on."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [x for x in info.read_text().splitlines() if x.startswith("model name")]
        name = models[0].partition(":")[2].strip() if models else name
    return {
        "processor": name,
        "cores": os.cpu_count(),
        "threads": threads,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "torch": torch.__version__,
        "python": platform.python_version(),
        "load": os.getloadavg()[0],
    }


def line(row: dict[str, Any]) -> str:
    """A row on the terminal while the rest is running."""
    cells = ", ".join(f"{n} {b['ms']:.2f} ms" for n, b in row["backends"].items())
    return f"{row['keyframes']} keyframes, {row['edges']} edges, {row['grid']}: {cells}"


def table(record: dict[str, Any]) -> str:
    """The result as a page."""
    machine = record["machine"]
    rows: Sequence[dict[str, Any]] = record["rows"]
    out = [
        "# One bundle adjustment step",
        "",
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} thread(s) used; "
        f"GPU: {machine['gpu']}; torch {machine['torch']}; load {machine['load']:.1f} at the end.",
        f"Median of {record['repeats']} steps in turn (a third of that from 350 keyframes on), "
        "least in brackets; float32"
        + (f", Huber threshold {record['huber']:g}" if record["huber"] else ", no robust kernel")
        + (", weights with an off-diagonal." if record["cross"] else "."),
        "Memory is what a step adds to the problem, beyond memory that was free already.",
        "",
        "| keyframes | edges | grid | backend | ms | of torch | floor ms | memory MB |",
        "|---:|---:|---|---|---:|---:|---:|---:|",
    ]
    for row in rows:
        for name, b in row["backends"].items():
            base = row["backends"].get("torch GPU" if name == "cuda" else "torch CPU")
            faster = f"{base['ms'] / b['ms']:.1f}x" if base and base is not b else ""
            out.append(
                f"| {row['keyframes']} | {row['edges']} | {row['grid']} | {name} "
                f"| {b['ms']:.2f} ({b['least_ms']:.2f}) | {faster} | {b['floor_ms']:.2f} "
                f"| {b['memory_mb']:.0f} |"
            )
    for device, speed in record["ceilings"].items():
        out.append("")
        out.append(
            f"Ceilings on {device}: {speed['bytes_per_s'] / 1e9:.1f} GB/s of a copy, "
            f"{speed['flops_per_s'] / 1e9:.0f} GFLOP/s of a matrix product."
        )
    return "\n".join(out) + "\n"


if __name__ == "__main__":
    main()
