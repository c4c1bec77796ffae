"""`droidw eval`: a run folder or a trajectory file against a reference."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from droidw.errors import UsageError

__all__ = ["HELP", "add_arguments", "main"]

HELP = "compare a trajectory with a reference: ATE, RPE, scale, motion-mask score"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `droidw eval`."""
    parser.add_argument(
        "path", metavar="RUNDIR_OR_TUM", help="run folder (reads trajectory.tum), or a TUM file"
    )
    parser.add_argument(
        "--ref",
        metavar="FILE",
        help="reference: a TUM file (t tx ty tz qx qy qz qw), or a folder with groundtruth.txt; "
        "default: the source of the run",
    )
    parser.add_argument(
        "--align",
        choices=("sim3", "se3", "scale", "none"),
        default="sim3",
        help="how the estimate is laid on the reference first (default: sim3)",
    )
    parser.add_argument(
        "--t-max-diff",
        metavar="S",
        type=float,
        default=0.02,
        help="largest time difference of two matched poses in seconds (default: 0.02)",
    )
    parser.add_argument(
        "--t-offset",
        metavar="S",
        type=float,
        default=0.0,
        help="seconds added to the stamps of the estimate (default: 0)",
    )
    parser.add_argument(
        "--delta",
        metavar="N",
        default="1",
        help="RPE: how far apart two poses are, in frames (10), seconds (0.5s) or metres of the "
        "reference's path (0.2m) (default: 1)",
    )
    parser.add_argument(
        "--normalise",
        choices=("none", "displacement", "path"),
        default="none",
        help="divide all lengths by the distance from the first to the last pose of the reference "
        "(the unit of published DyCheck figures), or by the length of its path (default: none)",
    )
    parser.add_argument(
        "--unit", metavar="U", default="m", help="unit of the reference, for display (default: m)"
    )
    parser.add_argument(
        "--masks",
        metavar="DIR",
        help="masks of what moves, to score uncertainty/ of the run folder; "
        "default: mask/ in the source of the run, if there is one",
    )
    parser.add_argument(
        "--masks-after",
        metavar="N",
        type=int,
        default=0,
        help="leave the first N keyframes out of the score of the masks (default: 0)",
    )
    parser.add_argument(
        "--plot", metavar="DIR", help="draw paths and errors into DIR, as SVG for any browser"
    )
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    parser.add_argument(
        "--save", action="store_true", help="also write them to metrics.json in the run folder"
    )


def main(args: argparse.Namespace) -> int:
    """Run `droidw eval` and return the exit code."""
    from droidw.eval.metrics import Delta
    from droidw.eval.summary import evaluate, write_metrics
    from droidw.eval.text import table

    path = Path(args.path)
    if args.masks_after < 0:
        raise UsageError(f"--masks-after counts keyframes from 0, and {args.masks_after} is less")
    if args.save and not path.is_dir():
        raise UsageError(f"--save writes into a run folder, and {path} is none")
    evaluation = evaluate(
        path,
        Path(args.ref) if args.ref else None,
        align=args.align,
        max_diff=args.t_max_diff,
        offset=args.t_offset,
        delta=Delta.parse(args.delta),
        normalise=args.normalise,
        unit=args.unit,
        masks=Path(args.masks) if args.masks else None,
        masks_after=args.masks_after,
    )
    if args.json:
        text = json.dumps(evaluation.to_dict(), indent=2, allow_nan=False)
    else:
        text = table(evaluation)
    sys.stdout.write(text + "\n")
    if args.plot:
        from droidw.eval.plots import write_plots

        for drawn in write_plots(evaluation, Path(args.plot)):
            sys.stderr.write(f"written: {drawn}\n")
    if args.save:
        saved = write_metrics(evaluation, path)
        sys.stderr.write(f"written: {saved}\n")
    return 0
