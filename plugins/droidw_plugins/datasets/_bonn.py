"""Opening a sequence of the Bonn RGB-D Dynamic dataset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from droidw.geometry import se3
from droidw.interfaces.datasets import Selection
from droidw.slam.frame import Trajectory
from droidw_plugins.datasets._listing import ListedSource
from droidw_plugins.datasets._named import Datasets
from droidw_plugins.datasets._rgbd import EXPECTED, open_rgbd
from droidw_plugins.datasets._truth import from_matrices

__all__ = ["BonnReader", "corrected"]

# The authors' own constants (REFERENCE 6.2). The poses are of a marker, in the axes of ROS; the
# second matrix goes from marker to camera, and is not exactly a rotation.
_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_MARKER = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def corrected(marker: Trajectory) -> Trajectory:
    """Poses of the camera from poses of the marker: ROS^T T ROS MARKER, camera to world."""
    T = se3.matrix(torch.from_numpy(marker.T_wc)).numpy()
    return from_matrices(marker.times, _ROS.T @ T @ _ROS @ _MARKER)


class BonnReader:
    """A `DatasetReader` for sequences of Bonn RGB-D Dynamic.

    Args:
        max_difference: a true pose belongs to a picture if it is this near in time, in s.
        datasets: where named sequences lie.
    """

    def __init__(self, max_difference: float, datasets: Datasets) -> None:
        self._max_difference = max_difference
        self._datasets = datasets

    def recognises(self, source: str) -> bool:
        """Whether it is `bonn:...` or a folder of the download, by its name."""
        path = Path(source)
        named = Datasets.names(source, "bonn")
        return named or (
            path.resolve().name.startswith("rgbd_bonn_") and (path / "rgb.txt").is_file()
        )

    def open(self, source: str, selection: Selection) -> ListedSource:
        """Open the sequence; see `DatasetReader.open`."""
        place = self._datasets.locate(source, "bonn", EXPECTED)
        out = open_rgbd(
            place,
            selection,
            self._max_difference,
            published=self._datasets.published,
            correct=corrected,
        )
        out.camera = self._datasets.camera(place, out.size, out.problems)
        return out
