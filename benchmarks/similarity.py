"""How similar features of the same place are in two views, raw and calibrated, per extractor.

CLEAN and MOVING are two folders of one camera path, the second with moving objects and `mask/`.
Where a cell of the background lies in another picture is measured on the clean ones; the scale of
similarities is found on the moving ones, as in a run: from what `flow` measured there, whatever
moves. Without folders, rendered rooms are measured, whose correspondence is exact.

    python benchmarks/similarity.py [CLEAN MOVING] [--gap 5] [--pairs 10] [--save NAME]
                                    [--extractors cnn,colours]

Columns: what a quarter and a half of the matches of `flow` stay below ("matches"), the same of the
static cells ("static"), the same and three quarters of the moving ones, compared with the
background that they hide ("moving"), and the chance that a moving cell is less alike than a static
one (AUC). The transformers have made-up weights, which track nothing: they stand for another space
of features. `random` are two layers that nobody trained, `colours` the colours of a patch.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from end_to_end import RESULTS, machine, today
from torch.nn import functional as F

from droidw.geometry.camera import Grid
from droidw.interfaces.correspondence import EdgeRequest
from droidw.interfaces.uncertainty import UncertaintyView
from droidw.plugin.component import BuildContext
from droidw.slam.frame import Frame
from droidw.testing.scenes import Scene, SceneSpec
from droidw_plugins._made_up import write_made_up
from droidw_plugins.correspondence import flow
from droidw_plugins.features import cnn, dinov2, fit3d
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty._matches import MatchScale, matches

SIZE = (320, 240)
GRID = Grid.of(SIZE[1], SIZE[0], 8, 3.5)
GRID_SIZE = (GRID.height, GRID.width)
CPU = BuildContext(torch.device("cpu"))


class RandomConvolutions:
    """Two layers that nobody trained."""

    def __init__(self) -> None:
        draw = torch.Generator().manual_seed(0)
        self.first = torch.randn(16, 3, 5, 5, generator=draw) * 0.16
        self.second = torch.randn(48, 16, 5, 5, generator=draw) * 0.07

    def extract(self, image: torch.Tensor, grid: Grid) -> torch.Tensor:
        """Features [48,h,w]."""
        x = F.conv2d(image[None], self.first, stride=2, padding=2).relu()
        x = F.conv2d(x, self.second, stride=2, padding=2).relu()
        return F.avg_pool2d(x, 2)[0, :, : grid.height, : grid.width]


class Colours:
    """The colours of a patch."""

    def extract(self, image: torch.Tensor, grid: Grid) -> torch.Tensor:
        """Features [12,h,w]."""
        patches = F.unfold(F.avg_pool2d(image[None], 4), 2, stride=2)
        return patches[0].view(-1, grid.height, grid.width)


def extractors(weights: Path) -> dict[str, Callable[[], Any]]:
    """name -> makes a fresh extractor."""
    write_made_up(weights, ["fit3d", "dinov2-vits14-reg"])
    raw = cnn.CnnOptions(calibration="none", constant=0.0)
    context = dataclasses.replace(CPU, weights_dir=weights)
    return {
        "cnn": lambda: cnn.COMPONENT.factory(cnn.CnnOptions(), CPU),
        "cnn, raw": lambda: cnn.COMPONENT.factory(raw, CPU),
        "dinov2": lambda: dinov2.COMPONENT.factory(dinov2.Dinov2Options(), context),
        "fit3d": lambda: fit3d.COMPONENT.factory(fit3d.Fit3dOptions(), context),
        "random": RandomConvolutions,
        "colours": Colours,
    }


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two pictures [3,H,W] with moving objects and what is known of them.

    `target` [h,w,2] and `confidence` [h,w,2 or 3] are measured on them; `background` [h,w,2] is
    where the place behind each cell lies in the second; `still`, `moving` [P] say what counts.
    """

    first: torch.Tensor
    second: torch.Tensor
    target: torch.Tensor
    confidence: torch.Tensor
    background: torch.Tensor
    still: torch.Tensor
    moving: torch.Tensor


def picture(path: Path) -> torch.Tensor:
    """A picture [3,240,320] in [0,1]."""
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"{path}: cannot be read as a picture")
    if image.shape[1::-1] != SIZE:
        image = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(image[..., ::-1].copy()).permute(2, 0, 1).float() / 255


def measured(first: torch.Tensor, second: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Target [h,w,2] and confidence [h,w,3] that `flow` gives for two pictures."""
    part = flow.COMPONENT.factory(flow.COMPONENT.options(), CPU)
    known = torch.tensor([260.0, 260.0, 159.5, 119.5])
    frames = [Frame(n, n / 30, image, known) for n, image in enumerate((first, second))]
    payload = [part.context(part.encode(f, GRID), f, GRID) for f in frames]
    y, x = torch.meshgrid(
        torch.arange(float(GRID.height)), torch.arange(float(GRID.width)), indexing="ij"
    )
    start = torch.stack([x, y], dim=-1).expand(2, -1, -1, -1).contiguous()
    request = EdgeRequest(
        [0, 1], [0, 1], [1, 0], start, torch.ones(start.shape[:3], dtype=torch.bool),
        payload.__getitem__, informed=False,
    )  # fmt: skip
    answer = part.session("window").update(request)
    return answer.target[0], answer.confidence[0]


def folder_pairs(clean: Path, moving: Path, gap: int, count: int) -> Iterator[Pair]:
    """Pairs spread evenly over two folders of the same camera path."""
    names = [p.name for p in sorted((moving / "rgb").iterdir())]
    for start in np.linspace(gap, len(names) - gap - 1, count).astype(int):
        ends = names[start], names[start + gap]
        background, sure = measured(*(picture(clean / "rgb" / n) for n in ends))
        first, second = (picture(moving / "rgb" / n) for n in ends)
        masks = [(moving / "mask" / n).with_suffix(".png") for n in ends]
        here, there = (picture(m)[0] > 0.5 for m in masks)
        covered = GRID.covered(here).flatten()
        hit = at(GRID.covered(there), background)
        seen = (sure[..., :2].mean(-1) > 0).flatten()
        yield Pair(
            first, second, *measured(first, second), background,
            seen & (covered == 0) & (hit == 0), seen & (covered > 0.99),
        )  # fmt: skip


def at(maps: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """Values [P] of a map [h,w], interpolated at cells [h,w,2]."""
    size = torch.tensor([GRID.width - 1.0, GRID.height - 1.0])
    found = F.grid_sample(maps[None, None], (where / size * 2 - 1)[None], align_corners=True)
    return found.flatten()


def scene_pairs(gap: int, count: int) -> Iterator[Pair]:
    """Pairs of rendered rooms; correspondence is exact, also that of what moves."""
    y, x = np.mgrid[: GRID.height, : GRID.width] * 8 + 3.5
    for seed in range(count):
        scene = Scene(SceneSpec(frames=gap + 1, noise=3.0, seed=seed))
        still_scene = Scene(SceneSpec(frames=gap + 1, noise=3.0, seed=seed, moving=False))
        found = scene.correspond(0, gap, np.stack([x, y], axis=-1))
        behind = still_scene.correspond(0, gap, np.stack([x, y], axis=-1))
        target, background = (
            torch.from_numpy((f.target - 3.5) / 8).float() for f in (found, behind)
        )
        images = [
            torch.from_numpy(scene.render(n).image).permute(2, 0, 1).float() / 255 for n in (0, gap)
        ]
        visible = torch.from_numpy(found.visible)
        moves = torch.from_numpy(found.moving).flatten()
        yield Pair(
            *images, target, visible.float()[..., None].repeat(1, 1, 2), background,
            visible.flatten() & ~moves, torch.from_numpy(behind.visible).flatten() & moves,
        )  # fmt: skip


def cosines(features: torch.Tensor, target: torch.Tensor, confidence: torch.Tensor) -> Any:
    """Cosines and weights [P] at the places [h,w,2] of two maps of features [2,C,h,w]."""
    none = torch.zeros(0)
    view = UncertaintyView(
        features=features, uncertainty=none, fields={}, T_cw=none, disps=torch.ones(2, *GRID_SIZE),
        intrinsics=none, ii=torch.tensor([0]), jj=torch.tensor([1]), target=target[None],
        confidence=confidence[None], frames=none,
    )  # fmt: skip
    found = matches(view, torch.ones(1, dtype=torch.bool), 0)
    assert found is not None
    rows = features.flatten(2).transpose(1, 2).float()
    return objective.similarity(rows, found[0])[0], found[1][0]


def measure(make: Callable[[], Any], pairs: list[Pair]) -> dict[str, Any]:
    """Quantiles of one extractor, raw and calibrated."""
    extractor, scale = make(), MatchScale()
    still, moving = [], []
    for pair in pairs:
        features = torch.stack([extractor.extract(p, GRID) for p in (pair.first, pair.second)])
        scale.look(*cosines(features, pair.target, pair.confidence))
        found, _ = cosines(features, pair.background, torch.ones_like(pair.confidence))
        still.append(found[pair.still])
        moving.append(found[pair.moving])
    s, m = torch.cat(still), torch.cat(moving)
    calibrated = getattr(extractor, "calibrated", False)

    def shares(values: torch.Tensor, levels: tuple[int, ...]) -> list[float]:
        return [round(float(v), 3) for v in np.percentile(values.numpy(), levels)]

    below = np.searchsorted(np.sort(s.numpy()), m.numpy()).mean() / len(s)
    return {
        "static_cells": len(s),
        "moving_cells": len(m),
        "matches": [round(1 - scale.quartile, 3), round(1 - scale.median, 3)],
        "raw_static": shares(s, (25, 50)),
        "raw_moving": shares(m, (25, 50, 75)),
        "static": shares(s if calibrated else scale(s), (25, 50)),
        "moving": shares(m if calibrated else scale(m), (25, 50, 75)),
        "auc": round(1 - float(below), 3),
        "own": calibrated,
    }


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path, help="CLEAN MOVING (none: rendered)")
    parser.add_argument("--gap", type=int, default=5, help="pictures between the two of a pair")
    parser.add_argument("--pairs", type=int, default=10, help="pairs (default 10)")
    parser.add_argument("--extractors", default="", help="names, comma between (default: all)")
    parser.add_argument("--save", metavar="NAME", help="write results/similarity_NAME.md, .json")
    args = parser.parse_args()
    if len(args.folders) not in (0, 2):
        parser.error("give two folders, CLEAN and MOVING, or none")
    torch.set_grad_enabled(False)
    source = scene_pairs(args.gap, args.pairs)
    if args.folders:
        source = folder_pairs(*args.folders, args.gap, args.pairs)
    pairs = list(source)
    title = f"{args.folders[1].name if args.folders else 'rendered rooms'}, {args.gap} apart"
    record: dict[str, Any] = {
        "benchmark": "similarity", "date": today(), "footage": title, "pairs": len(pairs),
        "torch": torch.__version__, "opencv": cv2.__version__, **machine(), "rows": {},
    }  # fmt: skip
    told = [
        "| features | raw: matches 25/50 % | raw: static 25/50 % | raw: moving 25/50/75 % | "
        "calibrated: static | calibrated: moving | AUC |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    print(title, *told, sep="\n")
    with tempfile.TemporaryDirectory() as folder:
        for name, make in extractors(Path(folder)).items():
            if args.extractors and name not in args.extractors.split(","):
                continue
            row = record["rows"][name] = measure(make, pairs)
            cells = [
                " ".join(f"{v:.3f}" for v in row[key])
                for key in ("matches", "raw_static", "raw_moving", "static", "moving")
            ]
            told.append(f"| {name} | " + " | ".join(cells) + f" | {row['auc']:.3f} |")
            print(told[-1], flush=True)
    if args.save:
        story = (
            f"{record['date']}, {title}, {len(pairs)} pairs, {row['static_cells']} static and "
            f"{row['moving_cells']} moving cells; torch {record['torch']}, OpenCV "
            f"{record['opencv']}, {record['cpu']}, commit {record['commit']}. Transformers with "
            "made-up weights. Made by `python benchmarks/similarity.py`."
        )
        path = RESULTS / f"similarity_{args.save}.md"
        path.write_text("\n".join(["# Similarity of features", "", story, "", *told]) + "\n")
        path.with_suffix(".json").write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
