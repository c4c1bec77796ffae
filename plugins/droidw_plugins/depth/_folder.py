"""The prior behind `file`: finds, reads and resizes depth maps."""

from __future__ import annotations

import contextlib
import logging
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from zipfile import BadZipFile

import cv2
import numpy as np
import numpy.typing as npt
import torch

from droidw.errors import ConfigError, InputError
from droidw.interfaces.depth import DepthMap
from droidw.io.listing import without_remark
from droidw.io.masks import facts_of, numbers_in_names, seconds_in_names, written_by_droidw
from droidw_plugins.depth._lookup import Lookup, Rule
from droidw_plugins.depth.file import FileDepthOptions

if TYPE_CHECKING:
    from droidw.slam.frame import Frame

__all__ = ["FileDepth", "read_depth"]

_SUFFIXES = (".png", ".npy", ".npz")
_LIST = "depth.txt"
_MILLIMETRES = 1000.0
_log = logging.getLogger(__name__)


class FileDepth:
    """Depth maps of a folder, found by time, by file name or by position of the frame: `Lookup`.

    Maps that droidw wrote (`scale.json` beside them says so) are found by index, have the scale and
    unit that is said there, and are not metric where it was not. A frame without a map gets none;
    `found` and `missing` count what was asked for.

    Args:
        options: see `FileDepthOptions`.
    Attributes:
        metric: as the options say, and what droidw says of maps of its own.
        available: number of maps. found, missing: frames asked for, with and without a map.
    Raises:
        ConfigError: no path is given, or `match="time"` where no times are known.
        InputError: the folder is missing or holds no depth maps, or the list is broken.
    """

    def __init__(self, options: FileDepthOptions) -> None:
        if not options.path:
            raise ConfigError(
                "depth.options.path: the depth prior 'file' needs a folder of depth maps",
                "give it: depth=file depth.options.path=FOLDER",
            )
        self._options = options
        self.metric = options.metric
        path = Path(options.path).expanduser()
        if not path.exists():
            raise InputError(
                f"depth.options.path: there is no folder or list {path}",
                "give a folder of .png, .npy or .npz files, or a depth.txt",
            )
        folder = path if path.is_dir() else path.parent
        listing = path / _LIST if path.is_dir() else path
        if listing.suffix.lower() in _SUFFIXES:
            raise InputError(
                f"depth.options.path: {path} is one depth map",
                f"give the folder that holds the maps: depth.options.path={folder}",
            )
        times: list[float] = []
        own = None if listing.is_file() else _own(folder)
        self._scale = options.scale or _MILLIMETRES
        if own is not None:
            numbers = numbers_in_names([f for f in folder.iterdir() if f.suffix == ".png"])
            self._files = [numbers[number] for number in sorted(numbers)]
            self._scale = options.scale or 1.0 / own.scale
            if options.metric and not own.metric:
                self.metric = False
                _log.info("%s: droidw wrote these maps, in scene units", folder)
        elif listing.is_file():
            times, self._files = _read_list(listing)
        else:
            found = (f for f in folder.iterdir() if f.suffix.lower() in _SUFFIXES)
            self._files = sorted(found, key=_natural)
        if not self._files:
            raise InputError(
                f"{folder} holds no depth maps",
                "expected are 16-bit .png files, or .npy or .npz files with one array each",
            )
        if options.match == "time" and not times and seconds_in_names(self._files) is None:
            raise ConfigError(
                f"depth.options.match: 'time' needs {folder / _LIST} with 'time file' in each "
                "line, or names that are seconds",
                "or choose depth.options.match=name or =index",
            )
        rule: Rule | None = None if options.match == "auto" else options.match
        if own is not None:
            rule = "index"
        self._lookup = Lookup(self._files, times, rule, options.max_time_gap)
        self.available = len(self._files)
        self.found = 0
        self.missing = 0

    def predict(self, frame: Frame) -> DepthMap | None:
        """The depth map of a frame at the size of its image, or None where there is none.

        Maps of another size are resized, each cell taking the nearest value, since averages
        across an edge are depths that nothing has.

        Raises:
            InputError: the file exists but cannot be read as a depth map.
        """
        file = self._lookup.of(frame)
        if file is None or not file.is_file():
            self.missing += 1
            if self.missing == 1:
                _log.warning(
                    "no depth map for frame %d (%s, t = %.3f s); %d maps are available in %s",
                    frame.index,
                    frame.name or "no name",
                    frame.time,
                    self.available,
                    self._files[0].parent,
                )
            return None
        self.found += 1
        depth = read_depth(file, self._scale)
        if self._options.max_depth > 0:
            depth[depth > self._options.max_depth] = 0.0
        height, width = frame.image.shape[-2:]
        if depth.shape != (height, width):
            rows = (np.arange(height) * 2 + 1) * depth.shape[0] // (2 * height)
            columns = (np.arange(width) * 2 + 1) * depth.shape[1] // (2 * width)
            depth = depth[rows[:, None], columns]
        return DepthMap(torch.from_numpy(depth).to(frame.image.device))


class _Own(NamedTuple):
    """What `scale.json` of exporter `depth` says: depth per value, and whether it is in metres."""

    scale: float
    metric: bool


def _own(folder: Path) -> _Own | None:
    """What droidw says of maps that it wrote, named by the index of the frame; None of others."""
    says = folder.parent if folder.name == "full" else folder
    if not written_by_droidw(says):
        return None
    facts = facts_of(says)
    try:
        own = _Own(float(facts["scale"]), facts["unit"] == "metres")
    except (ValueError, KeyError, TypeError):
        return None
    return own if math.isfinite(own.scale) and own.scale > 0 else None


def read_depth(file: Path, scale: float) -> npt.NDArray[np.float32]:
    """Depth [H,W] float32 of a .png (values / scale), .npy or .npz (as they are); 0 is unknown.

    Values that are negative or not finite become 0. An .npz may hold its map under "depth", or
    must hold a single array.

    Raises:
        InputError: the file is unreadable, has more than one channel or 8-bit values.
    """
    values: npt.NDArray[np.generic]
    if file.suffix.lower() == ".png":
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise InputError(f"the depth map {file} cannot be read as a picture")
        if image.dtype != np.uint16:
            raise InputError(
                f"the depth map {file} has {image.dtype.itemsize * 8} bits per value",
                "a depth .png has 16 bits and one channel; 8-bit pictures of depth are for the eye",
            )
        values, factor = image, 1.0 / scale
    else:
        values, factor = _read_array(file), 1.0
    values = np.squeeze(values)
    if values.ndim != 2 or values.size == 0:
        raise InputError(
            f"the depth map {file} has the shape {list(values.shape)}, not [height, width]"
        )
    depth: npt.NDArray[np.float32] = values.astype(np.float32)
    depth *= np.float32(factor)
    depth[~(np.isfinite(depth) & (depth > 0))] = 0.0
    return depth


def _read_array(file: Path) -> npt.NDArray[np.generic]:
    try:
        # Pickled objects could run code; a depth map never needs them.
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            array: npt.NDArray[np.generic] = loaded
        else:
            with loaded:
                names = list(loaded.files)
                if "depth" not in names and len(names) != 1:
                    raise InputError(
                        f"the depth map {file} holds {len(names)} arrays ({', '.join(names)}) and "
                        "none is called 'depth'"
                    )
                array = loaded["depth" if "depth" in names else names[0]]
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"the depth map {file} cannot be read: {error}") from error
    if array.dtype.kind not in "fiu":
        raise InputError(f"the depth map {file} holds values of type {array.dtype}, not numbers")
    return array


def _read_list(listing: Path) -> tuple[list[float], list[Path]]:
    """Times (ascending) and files of a depth.txt; '#' starts a comment."""
    entries: list[tuple[float, Path]] = []
    for number, line in enumerate(listing.read_text(errors="replace").splitlines(), start=1):
        parts = without_remark(line).split(maxsplit=1)
        if not parts:
            continue
        time = math.nan
        with contextlib.suppress(ValueError):
            time = float(parts[0])
        if len(parts) != 2 or not math.isfinite(time):
            raise InputError(
                f"{listing}, line {number}: '{line.strip()}' is not 'time file'",
                "e.g. 12.033333 depth/000361.png",
            )
        entries.append((time, listing.parent / parts[1].strip()))
    entries.sort(key=lambda entry: entry[0])
    return [time for time, _ in entries], [file for _, file in entries]


def _natural(file: Path) -> list[tuple[int, str]]:
    """Sort key in which 9.png comes before 10.png."""
    parts = re.split(r"([0-9]+)", file.name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]
