"""How well lines tell how a camera is turned, picture by picture, with what moves and all.

    python benchmarks/lines.py CLIP ... [--every 2] [--first 8] [--size 320x240]

CLIP is a folder with `rgb/`, `camera.txt` and `groundtruth.txt`. The first pictures are decided
together, later ones are followed from the one before, as in a run, but without any pose and without
a mask. Of each clip: pictures with enough lines, the share of the length of their lines that agrees
with three directions at right angles (of a tenth and of half of the pictures it is less), and for
pictures by that share how far they are turned from the true poses, after one turn of the whole
clip, in degrees: the median, what nine of ten stay below, and the most. Then the focal length at
which lines are off least, as a factor of the true one, and what looking for axes takes per picture.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from variants import read_clip

from droidw.geometry.se3 import rotation
from droidw.solve.manhattan import Axes, LineRays, axes_in_turn, next_axes
from droidw_plugins.correspondence._flow_lines import line_segments

SHARES = (0.0, 0.6, 0.75, 0.9, 1.01)
FACTORS = 1.0 + np.array([-0.06, -0.04, -0.03, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03, 0.04, 0.06])


def followed(pictures: list[LineRays], first: int) -> list[Axes | None]:
    """Axes of all pictures, the first ones decided together."""
    found = axes_in_turn(pictures[:first])
    for lines in pictures[first:]:
        last = next((axes for axes in reversed(found) if axes is not None), None)
        found.append(None if last is None else next_axes(lines, [last.turn]))
    return found


def turned_by(turns: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Degrees [n] between rotations [n,3,3] from axes to camera and from world to camera.

    The turn from axes to the world is the one that most of them agree with.
    """
    each = np.swapaxes(true, 1, 2) @ turns
    weight = np.ones(len(each))
    for _ in range(10):
        u, _, v = np.linalg.svd(np.einsum("n,nij->ij", weight, each))
        mean = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
        cosine = (np.einsum("nij,ij->n", each, mean) - 1) / 2
        off = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        weight = 1 / (1 + off**2)
    return off


def best_focal(
    segments: list[np.ndarray], found: list[Axes | None], pinhole: Sequence[float], least: float
) -> float:
    """Factor of the focal length at which lines of pictures with this share are off least."""
    fx, fy, cx, cy = pinhole
    energies = []
    for factor in FACTORS:
        energy = 0.0
        for lines, axes in zip(segments, found, strict=True):
            if axes is not None and axes.share >= least:
                rays = LineRays(lines, (factor * fx, factor * fy, cx, cy))
                energy += rays.energy(rays.fitted(axes.turn))
        energies.append(energy)
    at = min(max(int(np.argmin(energies)), 1), len(FACTORS) - 2)
    around = slice(at - 1, at + 2)
    a, b, _ = np.polyfit(FACTORS[around], energies[around], 2)
    return float(-b / (2 * a)) if a > 0 else float("nan")


def measure(folder: Path, size: tuple[int, int], every: int, first: int) -> str:
    """One row of the table."""
    clip = read_clip(folder, size)
    began = time.perf_counter()
    greys = [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in clip.pictures[::every]]
    segments = [line_segments(grey) for grey in greys]
    pictures = [LineRays(lines, clip.pinhole) for lines in segments]
    found = followed(pictures, first)
    took = (time.perf_counter() - began) / len(pictures)
    T_wc = torch.from_numpy(np.asarray(clip.poses[::every], np.float64))
    known = [k for k, axes in enumerate(found) if axes is not None]
    axes = [found[k] for k in known]
    share = np.array([a.share for a in axes])
    off = turned_by(np.array([a.turn for a in axes]), rotation(T_wc[known]).mT.numpy())
    row = [folder.name, f"{len(known)} of {len(pictures)}"]
    row.append(f"{np.percentile(share, 10):.2f}, {np.median(share):.2f}")
    for low, high in zip(SHARES[:-1], SHARES[1:], strict=True):
        inside = off[(share >= low) & (share < high)]
        text = ""
        if len(inside):
            figures = np.median(inside), np.percentile(inside, 90), inside.max()
            text = f"{len(inside)}: " + ", ".join(f"{figure:.2f}" for figure in figures)
        row.append(text)
    row.append(f"{best_focal(segments, found, clip.pinhole, SHARES[1]):.3f}")
    return "| " + " | ".join([*row, f"{1000 * took:.0f}"]) + " |"


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips", type=Path, nargs="+", metavar="CLIP")
    parser.add_argument("--every", type=int, default=2, help="take every n-th picture")
    parser.add_argument("--first", type=int, default=8, help="pictures that are decided together")
    parser.add_argument("--size", default="320x240", help="width and height of the pictures")
    asked = parser.parse_args(argv)
    width, height = (int(part) for part in asked.size.split("x"))
    print("| clip | pictures | share | below 0.6 | to 0.75 | to 0.9 | above | focal | ms |")
    print("|---|---|---|---|---|---|---|---|---|")
    for folder in asked.clips:
        print(measure(folder, (width, height), asked.every, asked.first), flush=True)


if __name__ == "__main__":
    main()
