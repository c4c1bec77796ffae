"""Opening a sequence of the TUM RGB-D benchmark."""

from __future__ import annotations

import re
from pathlib import Path

from droidw.geometry.camera import Camera
from droidw.interfaces.datasets import Selection
from droidw_plugins.datasets._layout import looks_like_tum
from droidw_plugins.datasets._listing import ListedSource
from droidw_plugins.datasets._named import Datasets
from droidw_plugins.datasets._rgbd import EXPECTED, open_rgbd

__all__ = ["TumReader"]

# Colour cameras of the benchmark as its authors publish them: fx fy cx cy, k1 k2 p1 p2 k3.
# The pictures of freiburg3 are undistorted already.
_PUBLISHED = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
_SIZE = (640, 480)


class TumReader:
    """A `DatasetReader` for sequences of the TUM RGB-D benchmark.

    Args:
        max_difference: a true pose belongs to a picture if it is this near in time, in s.
        datasets: where named sequences lie.
    """

    def __init__(self, max_difference: float, datasets: Datasets) -> None:
        self._max_difference = max_difference
        self._datasets = datasets

    def recognises(self, source: str) -> bool:
        """Whether it is `tum:...` or a folder in the layout of the download."""
        path = Path(source)
        named = Datasets.names(source, "tum")
        return named or (bool(source) and path.is_dir() and looks_like_tum(path))

    def open(self, source: str, selection: Selection) -> ListedSource:
        """Open the sequence; see `DatasetReader.open`."""
        place = self._datasets.locate(source, "tum", EXPECTED)
        out = open_rgbd(place, selection, self._max_difference, published=self._datasets.published)
        # a link may point to a folder of any name; what was asked for by name is known
        name = place.row.name if place.row is not None else place.folder.resolve().name
        out.camera = _published_camera(name, out.size, out.problems)
        return out


def _published_camera(name: str, size: tuple[int, int], problems: list[str]) -> Camera | None:
    """The benchmark's camera by the name of the sequence, or None."""
    match = re.search(r"(?:freiburg|fr)([123])(?!\d)", name)
    if match is None or size != _SIZE:
        problems.append(
            f"the name {name} does not say which camera of the benchmark took the pictures "
            "(freiburg1, 2 or 3, 640x480)"
        )
        return None
    four, bent = _PUBLISHED[match[1]]
    problems.append(
        f"camera: the published calibration of freiburg{match[1]}, taken by the folder's name"
    )
    return Camera(*_SIZE, *four, distortion=bent, model="opencv" if bent else "pinhole")
