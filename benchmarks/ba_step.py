"""Time of one bundle adjustment step against plain einsum, on synthetic windows.

Prints a table of medians and ratios measured in one run; the plain version is written here, in
the way that one writes down the equations, and is first checked to give the same step.

    python benchmarks/ba_step.py [--threads 2] [--repeats 9] [--json FILE] [--quick]
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from droidw.geometry import projective, se3
from droidw.solve.problem import BAProblem, Report, Step
from droidw_plugins.bundle.torch_ba import TorchBundleAdjuster

WINDOWS = ((12, 36), (25, 75), (60, 180))
GRIDS = ((30, 40), (48, 64))


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2, help="threads of torch (default 2)")
    parser.add_argument("--repeats", type=int, default=9, help="steps per median (default 9)")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument("--quick", action="store_true", help="the smallest window only")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)

    worst = check_equal(make_window(12, 36, 30, 40, torch.float64))
    print(f"the two agree to {worst:.1e} in float64 (12 keyframes, 36 edges, 30x40)")
    print(f"float32, {args.threads} threads, median of {args.repeats} (least in brackets), ms")
    print(f"{'keyframes':>9} {'edges':>6} {'grid':>6} {'droidw':>17} {'einsum':>17} {'ratio':>7}")
    rows = []
    for keyframes, edges in WINDOWS[:1] if args.quick else WINDOWS:
        for h, w in GRIDS[:1] if args.quick else GRIDS:
            problem = make_window(keyframes, edges, h, w, torch.float32)
            adjuster = TorchBundleAdjuster()
            ours, plain = alternate(
                lambda p=problem, a=adjuster: a.step(p),
                lambda p=problem: einsum_step(p),
                args.repeats,
            )
            row = {
                "keyframes": keyframes,
                "edges": edges,
                "grid": f"{h}x{w}",
                "droidw_ms": statistics.median(ours),
                "droidw_least_ms": min(ours),
                "einsum_ms": statistics.median(plain),
                "einsum_least_ms": min(plain),
            }
            row["ratio"] = row["einsum_ms"] / row["droidw_ms"]
            rows.append(row)
            print(
                f"{keyframes:9d} {edges:6d} {row['grid']:>6} "
                f"{row['droidw_ms']:8.1f} ({row['droidw_least_ms']:6.1f}) "
                f"{row['einsum_ms']:8.1f} ({row['einsum_least_ms']:6.1f}) {row['ratio']:6.1f}x",
                flush=True,
            )
    if args.json:
        record = {
            "benchmark": "ba_step",
            "torch": torch.__version__,
            "machine": platform.machine(),
            "threads": args.threads,
            "repeats": args.repeats,
            "agreement_float64": worst,
            "rows": rows,
        }
        args.json.write_text(json.dumps(record, indent=2) + "\n")


def make_window(n: int, n_edges: int, h: int, w: int, dtype: torch.dtype) -> BAProblem:
    """A window of n cameras on a curve over a wavy surface, slightly off its exact flow.

    Edges join neighbours in both directions first, then keyframes up to six apart.
    """
    g = torch.Generator().manual_seed(0)
    s = torch.linspace(0, 1, n, dtype=torch.float64)
    path = (0.8 * s, 0.1 * (4 * s).sin(), 0.2 * s, 0.05 * (3 * s).sin(), 0.1 * s, 0.03 * s)
    T_cw = se3.exp(torch.stack(path, dim=1))
    x, y = projective.pixel_grid(h, w, torch.float64).unbind(-1)
    k = torch.arange(n, dtype=torch.float64)[:, None, None]
    disps = 0.5 + 0.2 * (0.2 * x + k).sin() + 0.15 * (0.3 * y + 0.3 * k).cos()
    intrinsics = torch.tensor([0.9 * w, 0.9 * w, w / 2, h / 2], dtype=torch.float64)
    near = [(i, i + 1) for i in range(n - 1)]
    far = [(i, i + d) for i in range(n) for d in range(2, 7) if i + d < n]
    picked = [far[int(q)] for q in torch.randperm(len(far), generator=g)]
    pairs = (near + picked)[: (n_edges + 1) // 2]
    edges = torch.tensor([*pairs, *((j, i) for i, j in pairs)])[:n_edges]
    ii, jj = edges.T.contiguous()
    target, _ = projective.reproject(T_cw, disps, intrinsics, ii, jj)
    xi = 0.005 * torch.randn(n, 6, generator=g, dtype=torch.float64)
    xi[0] = 0
    wobble = 0.03 * torch.randn(n, h, w, generator=g, dtype=torch.float64)
    fixed = torch.zeros(n, dtype=torch.bool)
    fixed[0] = True
    return BAProblem(
        T_cw=se3.retract(T_cw, xi).to(dtype),
        disps=(disps * (1 + wobble)).to(dtype),
        intrinsics=intrinsics.to(dtype),
        ii=ii,
        jj=jj,
        target=target.to(dtype),
        weight=(0.1 + torch.rand(target.shape, generator=g, dtype=torch.float64)).to(dtype),
        fixed=fixed,
        damping=torch.full((n, h, w), 1e-4, dtype=dtype),
    )


def einsum_step(p: BAProblem) -> Step:
    """The step as the equations say it (REFERENCE 3.2, 3.3), dense in poses and depth maps."""
    n, h, w = p.disps.shape
    J_i, J_j, J_z = projective.jacobians(p.T_cw, p.disps, p.intrinsics, p.ii, p.jj)
    coords, valid = projective.reproject(p.T_cw, p.disps, p.intrinsics, p.ii, p.jj)
    r = p.target - coords
    W = p.weight * valid[..., None]
    cost = float((W * r * r).sum())
    H, v = r.new_zeros(n, n, 6, 6), r.new_zeros(n, 6)
    for a, J_a in ((p.ii, J_i), (p.jj, J_j)):
        v.index_put_((a,), torch.einsum("ehwc,ehwca,ehwc->ea", W, J_a, r), accumulate=True)
        for b, J_b in ((p.ii, J_i), (p.jj, J_j)):
            blocks = torch.einsum("ehwc,ehwca,ehwcb->eab", W, J_a, J_b)
            H.index_put_((a, b), blocks, accumulate=True)
    E = r.new_zeros(n, n, 6, h, w)
    E.index_put_((p.ii, p.ii), torch.einsum("ehwc,ehwca,ehwc->eahw", W, J_i, J_z), accumulate=True)
    E.index_put_((p.jj, p.ii), torch.einsum("ehwc,ehwca,ehwc->eahw", W, J_j, J_z), accumulate=True)
    C, b = p.damping.clone(), r.new_zeros(n, h, w)
    C.index_put_((p.ii,), torch.einsum("ehwc,ehwc,ehwc->ehw", W, J_z, J_z), accumulate=True)
    b.index_put_((p.ii,), torch.einsum("ehwc,ehwc,ehwc->ehw", W, J_z, r), accumulate=True)
    Q = 1.0 / C
    free = ~p.fixed
    E = E[free]
    S = H[free][:, free] - torch.einsum("akihw,khw,bkjhw->abij", E, Q, E)
    g = v[free] - torch.einsum("akihw,khw,khw->ai", E, Q, b)
    S = S.permute(0, 2, 1, 3).reshape(g.numel(), -1).double()
    S.diagonal().mul_(1.0 + p.lm).add_(p.ep)
    dx = torch.linalg.solve(S, g.reshape(-1).double()).view(-1, 6).to(r.dtype)
    dz = Q * (b - torch.einsum("akihw,ai->khw", E, dx))
    T_cw = p.T_cw.clone()
    T_cw[free] = se3.retract(p.T_cw[free], dx)
    disps = (p.disps + dz).clamp(p.min_disp, p.max_disp)
    return Step(T_cw, disps, Report("ok", cost))


def check_equal(problem: BAProblem) -> float:
    """Largest difference between the two steps; stops the benchmark above 1e-8."""
    ours, plain = TorchBundleAdjuster().step(problem), einsum_step(problem)
    worst = max(
        float((ours.T_cw - plain.T_cw).abs().max()), float((ours.disps - plain.disps).abs().max())
    )
    if not worst < 1e-8:
        raise SystemExit(f"the two steps differ by {worst:.1e}: nothing was measured.")
    return worst


def alternate(
    a: Callable[[], Step], b: Callable[[], Step], repeats: int
) -> tuple[list[float], list[float]]:
    """Milliseconds of two functions called in turn, so that both see the same machine."""
    times: tuple[list[float], list[float]] = ([], [])
    for k in range(repeats + 1):
        for call, kept in zip((a, b), times, strict=True):
            start = time.perf_counter()
            call()
            if k:  # the first call warms up
                kept.append(1e3 * (time.perf_counter() - start))
    return times


if __name__ == "__main__":
    main()
