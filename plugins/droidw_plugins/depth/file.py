"""Depth prior `file`: depth maps from a folder, one per frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from droidw.plugin.component import BuildContext, Component

if TYPE_CHECKING:
    from droidw.interfaces.depth import DepthPrior

__all__ = ["COMPONENT", "FileDepthOptions"]


@dataclass(frozen=True)
class FileDepthOptions:
    """Options of the depth prior `file`."""

    path: str = field(
        default="",
        metadata={
            "help": "folder of depth maps (.png of 16 bit, .npy, .npz), or a list of them as "
            "depth.txt: 'time file' in each line, or a sequence such as bonn:balloon"
        },
    )
    scale: float = field(
        default=0.0,
        metadata={
            "help": "values of a .png per metre (0: 1000, which is millimetres, or what is known "
            "of the named sequence)",
            "ge": 0,
        },
    )
    match: Literal["auto", "index", "name", "time"] = field(
        default="auto",
        metadata={
            "help": "how maps belong to frames: time (with depth.txt, or names that are seconds), "
            "file name, or position of the frame in the source (numbers as names count frames from "
            "0, but 1, 2, 3 and so on without a gap from 1); auto: time with depth.txt, else name "
            "where maps are called like pictures, else time or position; a frame without a map of "
            "its own gets none"
        },
    )
    max_time_gap: float = field(
        default=0.02, metadata={"help": "seconds between frame and map at most", "ge": 0}
    )
    max_depth: float = field(
        default=0.0, metadata={"help": "farther depths are unknown, in metres (0: keep)", "ge": 0}
    )
    metric: bool = field(
        default=True, metadata={"help": "the maps are in metres, and so becomes the result"}
    )


def _build(options: FileDepthOptions, context: BuildContext) -> DepthPrior:
    from droidw_plugins.depth._folder import FileDepth

    return FileDepth(_located(options, context))


def _located(options: FileDepthOptions, context: BuildContext) -> FileDepthOptions:
    """The options with the folder and the scale that a name such as `bonn:balloon` means."""
    from droidw.errors import ConfigError
    from droidw.io.dataset_tables import data_root, load_table, split_source, table_names

    parted = split_source(options.path)
    if parted is None or parted[0] not in table_names():
        return options
    row = load_table(parted[0]).sequence(parted[1])
    if not row.depth:
        raise ConfigError(
            f"depth.options.path: {row.source} has no depth maps", "name a folder, or depth=none"
        )
    folder = (context.data_dir or data_root()) / row.folder / str(row.depth["path"])
    scale = options.scale or float(row.depth["scale"])
    return replace(options, path=str(folder), scale=scale)


COMPONENT: Component[DepthPrior] = Component(
    name="file",
    summary="depth maps from a folder (16-bit PNG, NPY, NPZ), by time, name or position",
    factory=_build,
    options=FileDepthOptions,
    capabilities=frozenset({"cpu", "cuda", "depth"}),
)
