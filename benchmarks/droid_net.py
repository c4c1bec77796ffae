"""Time and memory of correspondence `droid`: encoders, correlation, update operator, whole preset.

Weights are made by a rule, which costs the same time as trained ones and tracks nothing. Beside the
update operator and the motion filter stands the published order of the same arithmetic (REFERENCE
1.4: every edge on its own), written here, checked to give the same, and timed in turn with ours.

    python benchmarks/droid_net.py [--device cpu|cuda] [--threads 1] [--repeats 3] [--quick]
                                   [--edges 1 25 75] [--run 160x128] [--out FOLDER]

The result goes to FOLDER (benchmarks/results) as droid_net_DEVICE.json and .md.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import statistics
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from droidw.geometry.camera import Grid
from droidw.geometry.projective import pixel_grid
from droidw.graph.store import KeyframeInfo, KeyframeStore
from droidw.interfaces.correspondence import EdgeRequest
from droidw_plugins.correspondence._droid import DroidCorrespondence, DroidKeyframe
from droidw_plugins.correspondence._droid_net import DroidNet
from droidw_plugins.correspondence._droid_state import expected_shapes
from droidw_plugins.correspondence.droid import DroidOptions

SIZES = ((240, 320), (384, 512), (360, 640))
SOURCES = {1: 1, 25: 8, 75: 20}
# REFERENCE 7.3, MB: a keyframe on the GPU, a volume edge, an edge of the low-memory mode (the last
# is given for 384x512 alone, and follows from the shapes for the others).
PUBLISHED = {(240, 320): (3.49, 3.8, 0.33), (384, 512): (8.92, 25.1, 0.84), (360, 640): (
    10.46, 34.2, 0.98)}  # fmt: skip
LIMITS = {"keyframe": 5.0, "volume edge": 26.0}


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default 1)")
    parser.add_argument("--repeats", type=int, default=3, help="calls per figure (default 3)")
    parser.add_argument("--edges", type=int, nargs="*", default=[1, 25, 75], help="edges at once")
    parser.add_argument("--run", default="", help="size of the clip of the whole preset, or none")
    parser.add_argument("--quick", action="store_true", help="the smallest size only, no run")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.set_grad_enabled(False)
    device = torch.device(args.device)
    net = DroidNet.from_state(rule_state(), device)
    precisions = ["float32", "float16"] if device.type == "cuda" else ["float32"]
    record: dict[str, Any] = {
        "benchmark": "droid_net",
        "device": torch.cuda.get_device_name() if device.type == "cuda" else platform.machine(),
        "torch": torch.__version__,
        "threads": args.threads,
        "repeats": args.repeats,
        "clock": "" if device.type == "cuda" else " of processor time",
        "load": round(os.getloadavg()[0], 1),
        "times": [],
        "memory": [memory(net, device, *size) for size in SIZES],
    }
    for size in SIZES[:1] if args.quick else SIZES:
        for precision in precisions:
            part = DroidCorrespondence(net, DroidOptions(precision=precision), device)
            for row in time_parts(part, *size, args.edges, args.repeats):
                row = {"size": f"{size[0]}x{size[1]}", "precision": precision, **row}
                record["times"].append(row)
                print(line(row), flush=True)
    if not args.quick:
        width, height = (args.run or ("512x384" if device.type == "cuda" else "160x128")).split("x")
        record["preset"] = whole_preset(int(width), int(height), device)
    text = page(record)
    print(text)
    args.out.mkdir(parents=True, exist_ok=True)
    name = f"droid_net_{device.type}" + ("_quick" if args.quick else "")
    (args.out / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
    (args.out / f"{name}.md").write_text(text)


def rule_state() -> dict[str, Tensor]:
    """Weights that depend on nothing but the key and the shape."""
    state = {}
    for key, shape in expected_shapes().items():
        seed = zlib.crc32(("droidw-parity/" + key).encode()) & 0x7FFFFFFF
        scale = math.sqrt(2 / math.prod(shape[1:])) if len(shape) > 1 else 0.05
        values = np.random.RandomState(seed).standard_normal(shape) * scale
        state[key] = torch.from_numpy(values.astype(np.float32))
    return state


# -- time ----------------------------------------------------------------------------------


def clock(
    device: torch.device, repeats: int, *calls: Callable[[], object]
) -> list[tuple[float, float]]:
    """(median, least) milliseconds of functions called in turn, after one call to warm up.

    On a CPU it is processor time, which other programs disturb less than the clock on the wall.
    """
    now = time.perf_counter if device.type == "cuda" else time.process_time
    times: list[list[float]] = [[] for _ in calls]
    for k in range(repeats + 1):
        for call, kept in zip(calls, times, strict=True):
            start = now()
            call()
            if device.type == "cuda":
                torch.cuda.synchronize()
            if k:
                kept.append(1e3 * (now() - start))
    return [(statistics.median(kept), min(kept)) for kept in times]


def time_parts(
    part: DroidCorrespondence, height: int, width: int, counts: list[int], repeats: int
) -> Iterator[dict[str, Any]]:
    """Rows of the table of times for pictures of one size."""
    device, net = part.device, part.net
    image = torch.rand(1, 3, height, width, device=device)
    grid = pixel_grid(height // 8, width // 8, device=device)

    def run(call: Callable[[], object]) -> Callable[[], object]:
        def inside() -> object:
            with part.computing():
                return call()

        return inside

    for name, call in (("fnet", net.features), ("cnet", net.context)):
        [(median, least)] = clock(device, repeats, run(lambda c=call: c(image)))
        yield {"what": name, "ms": median, "least": least}
    payloads = made_up(part, max(SOURCES.values()) + 1, height, width)
    part._latest = payloads[0]
    both = clock(
        device, repeats,
        lambda: part.motion(payloads[0], payloads[1]),
        run(lambda: published_motion(part, payloads[0], payloads[1], grid)),
    )  # fmt: skip
    yield {"what": "motion filter", "ms": both[0][0], "least": both[0][1],
                 "published order": both[1][1]}  # fmt: skip
    for count in counts:
        sources = SOURCES.get(count, max(1, count // 4))
        ii = sorted(k % sources for k in range(count))
        jj = [(i + 1 + k % 3) % len(payloads) for k, i in enumerate(ii)]
        coords = grid + torch.rand(count, 1, 1, 2, device=device)
        request = EdgeRequest(
            list(range(count)), ii, jj, coords, coords[..., 0] > -1, payloads.__getitem__
        )
        for mode in ("volume", "lowmem"):
            owner = DroidCorrespondence(
                net, DroidOptions(precision=part.options.precision, correlation=mode), device
            )
            session = owner.session()
            edges = session._state(request, range(count), coords)
            call = run(partial(session._correlation, request, range(count), coords, edges))
            [(median, least)] = clock(device, repeats, call)
            yield {"what": f"correlation {mode}", "edges": count, "ms": median,
                         "least": least}  # fmt: skip
            del session, edges
        yield time_update(part, payloads, ii, repeats)


def time_update(
    part: DroidCorrespondence, payloads: list[DroidKeyframe], ii: list[int], repeats: int
) -> dict[str, Any]:
    """One row: the update operator beside its published order."""
    device, net = part.device, part.net
    sources = sorted(set(ii))
    h, w = payloads[0].fmap.shape[-2:]

    def last(x: Tensor) -> Tensor:
        return x.contiguous(memory_format=torch.channels_last)

    hidden = last(torch.stack([part.working(payloads[i].net) for i in ii]))
    inp = last(torch.stack([part.working(payloads[i].inp) for i in sources]))
    corr = last(torch.randn(len(ii), 196, h, w, device=device))
    motion = last(torch.randn(len(ii), 4, h, w, device=device))
    which = torch.tensor([sources.index(i) for i in ii], device=device)
    repeated = inp[which]

    def ours() -> Tensor:
        with part.computing():
            return net.update(hidden, inp, corr, motion, which).delta

    def theirs() -> Tensor:
        with part.computing():
            return published_update(net, hidden, repeated, corr, motion)

    error = float((ours() - theirs()).norm() / theirs().norm())
    if not error < (1e-4 if part.mixed is None else 5e-2):
        raise SystemExit(f"the two orders differ by {error:.1e}: nothing was measured.")
    both = clock(device, repeats, ours, theirs)
    return {"what": "update operator", "edges": len(ii), "ms": both[0][0], "least": both[0][1],
            "published order": both[1][1], "difference": error}  # fmt: skip


def published_update(
    net: DroidNet, hidden: Tensor, inp: Tensor, corr: Tensor, motion: Tensor
) -> Tensor:
    """`delta` with one convolution after the other, as the published code has them."""
    u, gru = net.update, net.update.gru
    x = torch.cat([inp, u.corr_encoder(corr), u.flow_encoder(motion)], 1)
    g = (torch.sigmoid(gru.w(hidden)) * hidden).mean(dim=(2, 3), keepdim=True)
    both = torch.cat([hidden, x], 1)
    z = torch.sigmoid(gru.convz(both) + gru.convz_glo(g))
    r = torch.sigmoid(gru.convr(both) + gru.convr_glo(g))
    q = torch.tanh(gru.convq(torch.cat([r * hidden, x], 1)) + gru.convq_glo(g))
    hidden = (1 - z) * hidden + z * q
    delta, weight = u.delta(hidden), torch.sigmoid(u.weight(hidden))
    F.relu(u.agg.conv1(hidden))
    del weight
    return delta.permute(0, 2, 3, 1).float()


def published_motion(
    part: DroidCorrespondence, reference: DroidKeyframe, current: DroidKeyframe, grid: Tensor
) -> float:
    """The motion filter with the whole update operator, correlation as ours."""
    from droidw_plugins.correspondence._droid_corr import Pyramid, lookup_lowmem

    pyramid = Pyramid(*grid.shape[:2])
    pair = part.working(reference.fmap), pyramid.features(part.working(current.fmap))
    corr = lookup_lowmem([pair], grid[None], pyramid)
    hidden, inp = (part.working(x)[None] for x in (reference.net, reference.inp))
    zeros = corr.new_zeros(1, 4, *grid.shape[:2])
    delta = published_update(part.net, hidden, inp, corr, zeros)
    return float(delta.norm(dim=-1).mean())


def made_up(part: DroidCorrespondence, count: int, height: int, width: int) -> list[DroidKeyframe]:
    """Payloads of keyframes with random content."""
    g = torch.Generator().manual_seed(0)
    payloads = []
    for k in range(count):
        maps = [torch.rand(128, height // 8, width // 8, generator=g) for _ in range(3)]
        payloads.append(DroidKeyframe(k, *(m.to(part.device, part.stored) for m in maps)))
    return payloads


# -- memory --------------------------------------------------------------------------------


def memory(net: DroidNet, device: torch.device, height: int, width: int) -> dict[str, Any]:
    """Bytes per keyframe and per edge with the default options, from what is really held."""
    part = DroidCorrespondence(net, DroidOptions(), device)
    payloads = made_up(part, 2, height, width)
    grid = Grid.of(height, width, part.stride, part.offset)
    store = KeyframeStore(grid, torch.tensor([1.0, 1, 1, 1]), 384, (), device, torch.float16)
    picture = np.zeros((height, width, 3), np.uint8)
    store.append(KeyframeInfo(0, 0.0, "", picture, payloads[0]))
    maps = sum(field[0].nbytes for field in store._data.values())
    payload = sum(x.nbytes for x in (payloads[0].fmap, payloads[0].net, payloads[0].inp))
    coords = pixel_grid(grid.height, grid.width, device=device)[None]
    request = EdgeRequest([0], [0], [1], coords, coords[..., 0] > -1, payloads.__getitem__)
    found = {"size": f"{height}x{width}", "keyframe": (maps + payload) / 1e6,
             "picture on the host": picture.nbytes / 1e6}  # fmt: skip
    for mode in ("volume", "lowmem"):
        part.options = DroidOptions(correlation=mode)
        session = part.session()
        session._state(request, [0], coords)
        # target and confidence of an edge stand in the factor graph besides
        found[f"{mode} edge"] = (session.nbytes + 2 * coords.nbytes) / 1e6
    published = dict(zip(("keyframe", "volume edge", "lowmem edge"), PUBLISHED[height, width],
                         strict=True))  # fmt: skip
    return {**found, "published": published}


# -- the whole preset ------------------------------------------------------------------------


def whole_preset(width: int, height: int, device: torch.device) -> dict[str, Any]:
    """Frames per second of `droidw run --preset paper` on 30 rendered frames."""
    from droidw.cli.main import main as command
    from droidw.testing.scenes import Scene, SceneSpec
    from droidw_plugins._vit.published import FORMS, transformer_shapes
    from droidw_plugins.depth._metric3d_net import published_shapes

    variant = "vit-large" if device.type == "cuda" else "vit-small"
    size = [616, 1064] if device.type == "cuda" else [112, 140]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        torch.save(rule_state(), folder / "droid.pth")
        shapes = {"fit3d": transformer_shapes(*FORMS["fit3d"]),
                  f"metric3d-{variant}": published_shapes(variant)}  # fmt: skip
        for stem, wanted in shapes.items():
            g = torch.Generator().manual_seed(0)
            state = {
                key: 0.02 * torch.randn(shape, generator=g) + float(key.endswith("norm.weight"))
                for key, shape in wanted.items()
            }
            torch.save(state, folder / f"{stem}.pth")
        spec = SceneSpec(width=width, height=height, frames=30, motion="handheld")
        Scene(spec).write(folder / "clip")
        os.environ["DROIDW_WEIGHTS"] = str(folder)
        code = command(
            ["run", str(folder / "clip"), "-o", str(folder / "out"), "--preset", "paper",
             "--device", device.type, f"camera.size=[{width},{height}]",
             f"depth.options={{variant: {variant}, size: {size}}}",
             "observers.report=null", "observers.progress=null"]
        )  # fmt: skip
        if code:
            raise SystemExit(f"the preset ended with exit code {code}")
        facts = json.loads((folder / "out" / "manifest.json").read_text())
    return {"size": f"{height}x{width}", "depth": f"metric3d {variant} at {size}",
            **{key: facts[key] for key in ("frames", "keyframes", "fps", "stages")}}  # fmt: skip


# -- text ------------------------------------------------------------------------------------


def line(row: dict[str, Any]) -> str:
    """A row of the table of times, as Markdown."""
    plain = row.get("published order")
    ratio = f"{plain:.0f} | {plain / row['least']:.2f}" if plain else "| "
    return (
        f"| {row['size']} | {row['precision']} | {row['what']} | {row.get('edges', '')} | "
        f"{row['ms']:.1f} | {row['least']:.1f} | {ratio} |"
    )


def page(record: dict[str, Any]) -> str:
    """The whole result as Markdown."""
    text = [
        f"# droid_net on {record['device']}", "",
        f"torch {record['torch']}, threads: {record['threads']}, {record['repeats']} calls each, "
        f"milliseconds{record['clock']}, load {record['load']}. \"Published order\": the same "
        "arithmetic, every edge on its own, least.", "",
        "| size | precision | what | edges | median | least | published order | ratio |",
        "|---|---|---|---|---|---|---|---|", *map(line, record["times"]), "",
        "Memory in MB, default options (half precision in the store); published in brackets "
        f"(REFERENCE 7.3). Limits at 384x512: {LIMITS}.", "",
        "| size | keyframe | volume edge | low-memory edge | picture on the host |",
        "|---|---|---|---|---|",
    ]  # fmt: skip
    for row in record["memory"]:
        cells = [
            f"{row[k]:.2f} ({row['published'][k]})"
            for k in ("keyframe", "volume edge", "lowmem edge")
        ]
        cells.append(f"{row['picture on the host']:.2f}")
        text.append(f"| {row['size']} | " + " | ".join(cells) + " |")
    if "preset" in record:
        run = record["preset"]
        text += ["", f"Preset `paper` at {run['size']} with {run['depth']}: {run['frames']} frames "
                 f"({run['keyframes']} keyframes) at {run['fps']:.2f} frames/s."]  # fmt: skip
    return "\n".join(text) + "\n"


if __name__ == "__main__":
    main()
