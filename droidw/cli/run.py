"""`droidw run`: footage in, run folder out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droidw.cli.options import add_plugin_arguments, plugins_from
from droidw.errors import UsageError

if TYPE_CHECKING:
    from droidw.plugin.manager import Plugins
    from droidw.slam.frame import RunResult

__all__ = ["HELP", "add_arguments", "execute", "main"]

HELP = "track a video or a folder of pictures and write the run folder"
USAGE = "%(prog)s SOURCE [options] [key=value ...]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `droidw run`."""
    parser.add_argument(
        "items",
        metavar="SOURCE [key=value ...]",
        nargs="*",
        help="a video, a folder of pictures or reader:sequence; then configuration overrides, "
        "which win over everything (every key: docs/configuration.md)",
    )
    parser.add_argument("-o", "--output", metavar="RUNDIR", help="output folder (runs/NAME)")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier run there")
    parser.add_argument(
        "--config", metavar="FILE", action="append", default=[], help="YAML file; may be repeated"
    )
    parser.add_argument(
        "--preset",
        default=None,
        help="cpu, quick, paper, droid-slam, or auto: paper where its parts and weights are there, "
        "else cpu (default: auto, unless a --config file extends a preset or sets every section)",
    )
    parser.add_argument("--calib", metavar="FILE", help="calibration of the raw pictures")
    parser.add_argument("--focal", metavar="PX", help="focal length in pixels of the raw pictures")
    parser.add_argument("--fov", metavar="DEG", help="horizontal field of view in degrees")
    parser.add_argument("--stride", metavar="N", help="keep every n-th picture")
    parser.add_argument("--skip", metavar="N", help="leave out the first n pictures")
    parser.add_argument("--max-frames", metavar="N", help="stop after n pictures")
    parser.add_argument(
        "--masks",
        metavar="DIR",
        help="folder with a mask per picture, of the same name or in the same order: what is not "
        "black there is ignored",
    )
    parser.add_argument(
        "--data",
        metavar="DIR",
        help="folder of datasets for SOURCE like bonn:balloon (DROIDW_DATA)",
    )
    parser.add_argument("--device", metavar="D", help="auto, cpu, cuda, cuda:N")
    parser.add_argument("--seed", metavar="N", help="seed of everything that draws numbers")
    add_plugin_arguments(parser)


_FLAGS = {
    "focal": "camera.focal",
    "fov": "camera.fov",
    "stride": "input.stride",
    "skip": "input.skip",
    "max_frames": "input.max_frames",
    "device": "device",
    "seed": "seed",
}
"""Flag -> configuration key that it is another spelling of."""


def _in_full(source: str) -> str:
    """A file or folder by its whole path, so that what is kept of a run holds from anywhere."""
    return str(Path(source).resolve()) if Path(source).exists() else source


def main(args: argparse.Namespace) -> int:
    """Run, and say where the files are.

    Raises:
        DroidwError: as `droidw.run.run`.
    """
    source, overrides = _split(args.items)
    values = {} if source is None else {"input.source": _in_full(source)}
    if args.calib is not None:
        values["camera.calib"] = _in_full(args.calib)
    if args.masks is not None:
        values["input.masks"] = _in_full(args.masks)
    flags = [
        f"{key}={getattr(args, flag)}"
        for flag, key in _FLAGS.items()
        if getattr(args, flag) is not None
    ]
    if args.quiet:
        overrides.append("observers.progress.enabled=false")
    plugins = plugins_from(args)
    if args.data is not None:
        plugins.data_dir = Path(args.data).expanduser()
    result = execute(
        plugins,
        [Path(f) for f in args.config],
        args.preset,
        flags + overrides,
        Path(args.output) if args.output else None,
        values=values,
        overwrite=args.overwrite,
    )
    if not args.quiet:
        print(summary(result))
    return 0


def execute(
    plugins: Plugins,
    files: list[Path],
    preset: str | None,
    overrides: list[str],
    run_dir: Path | None,
    *,
    values: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> RunResult:
    """Resolve a configuration and run it; `run_dir` None means a new folder below runs/.

    Without a preset, files that are only changes are put on the preset `auto`, as overrides are.
    """
    from droidw.config.load import load_config
    from droidw.config.resolve import choose_preset, needs_preset, resolve

    note = ""
    if preset == "auto" or (preset is None and needs_preset(files)):
        preset, note = choose_preset(plugins)
    resolved = resolve(load_config(files, preset, overrides, values), plugins)
    source = resolved.config.input.source
    if not source:
        raise UsageError("no SOURCE is given", "type: droidw run SOURCE [-o RUNDIR]")
    from droidw.run import run

    return run(resolved, plugins, run_dir or _fresh(source), overwrite=overwrite, note=note)


def _split(items: list[str]) -> tuple[str | None, list[str]]:
    """(SOURCE, overrides): the source comes first and may contain '=' if it exists."""
    if not items:
        return None, []
    first, *rest = items
    if "=" in first and not Path(first).exists():
        first, rest = "", items
    for item in rest:
        if "=" not in item:
            raise UsageError(
                f"'{item}' is neither an option nor an override",
                "one SOURCE comes first, then key=value; options start with --",
            )
    return first or None, rest


def _fresh(source: str) -> Path:
    """A folder below runs/ that is not there yet."""
    name = Path(source.rstrip("/")).stem.replace(":", "-") or "run"
    base = Path("runs") / name
    number = 1
    folder = base
    while folder.exists():
        number += 1
        folder = base.with_name(f"{name}-{number}")
    return folder


def summary(result: RunResult) -> str:
    """What a run came to, and where its files are."""
    facts = result.manifest
    counts = {
        "frame": facts["frames"],
        "keyframe": facts["keyframes"],
        "point": len(result.cloud.xyz),
    }
    told = [f"{count} {noun}{'s' * (count != 1)}" for noun, count in counts.items()]
    lines = [f"{', '.join(told)}, {facts['fps']:.1f} frames/s, scale {facts['scale']}"]
    width = max((len(name) for name in facts["files"]), default=0)
    for name, meaning in facts["files"].items():
        lines.append(f"  {result.run_dir}/{name:<{width}}  {meaning}")
    return "\n".join(lines)
