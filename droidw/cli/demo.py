"""`droidw demo`: a synthetic scene with a moving object, run and evaluated like any footage."""

from __future__ import annotations

import argparse
from pathlib import Path

from droidw.cli.options import add_plugin_arguments, plugins_from
from droidw.errors import UsageError

__all__ = ["HELP", "add_arguments", "main"]

HELP = "render a short scene with exact truth, run on it, and evaluate the run"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `droidw demo`."""
    parser.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        default="runs/demo",
        help="folder for the footage (DIR/footage) and the run (DIR/run); default runs/demo",
    )
    parser.add_argument("--frames", type=int, default=90, help="frames to render (90)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the scene and the run (0)")
    add_plugin_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Render, run, evaluate, and say what came of it.

    Raises:
        DroidwError: as `droidw run` and `droidw eval`.
    """
    if args.frames < 20:
        raise UsageError(f"--frames {args.frames}: too short to track", "valid: 20 or more")
    from droidw.cli.run import execute, summary
    from droidw.eval.summary import evaluate
    from droidw.testing.scenes import Scene, SceneSpec

    out = Path(args.output)
    footage, run_dir = out / "footage", out / "run"
    print(f"rendering {args.frames} frames with exact truth into {footage}", flush=True)
    Scene(SceneSpec(frames=args.frames, seed=args.seed)).write(footage)
    plugins = plugins_from(args)
    result = execute(
        plugins,
        [],
        "cpu",
        [f"seed={args.seed}"],
        run_dir,
        values={"input.source": str(footage)},
        overwrite=run_dir.exists(),
    )
    print(summary(result))
    scores = evaluate(run_dir, footage / "groundtruth.txt")
    ate = scores.to_dict()
    print(
        f"ATE {ate['ate_rmse']:.4f} {ate['unit']} RMSE over {ate['matched']} of "
        f"{ate['frames']} frames after Sim(3), path {ate['path_length']:.2f} m"
    )
    if scores.masks is not None:
        masks = scores.masks.to_dict()
        print(f"motion mask: AUC {masks['auc']:.3f}, best F1 {masks['f1']:.3f}")
    print(f"speed {result.manifest['fps']:.1f} frames/s; open {run_dir}/report.html")
    return 0
