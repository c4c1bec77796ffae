"""From `bonn:balloon` or a path to the folder of a sequence and its row in the table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from droidw.errors import InputError
from droidw.io.dataset_tables import (
    DATA_VARIABLE,
    KnownSequence,
    data_root,
    load_table,
    split_source,
)

if TYPE_CHECKING:
    from droidw.geometry.camera import Camera
    from droidw.plugin.component import BuildContext

__all__ = ["Datasets", "Place", "existing_folder"]

_COMPAT = "droid-w"


@dataclass(frozen=True)
class Place:
    """Where a sequence lies, what to call it, and its row in the table, if it has one."""

    folder: Path
    name: str
    row: KnownSequence | None = None


@dataclass(frozen=True)
class Datasets:
    """What readers of named datasets share.

    Attributes:
        given: folder of datasets that the run names, or None for the usual one.
        published: reproduce what the published system does (`compat: [droid-w]`).
    """

    given: Path | None = None
    published: bool = False

    @classmethod
    def of(cls, context: BuildContext | None) -> Datasets:
        """As the run says; the usual folder where there is no run."""
        if context is None:
            return cls()
        return cls(context.data_dir, _COMPAT in context.compat)

    @property
    def root(self) -> Path:
        """The folder of datasets."""
        return self.given or data_root()

    @staticmethod
    def names(source: str, dataset: str) -> bool:
        """Whether a source is of the form `dataset:...`."""
        parted = split_source(source)
        return parted is not None and parted[0] == dataset

    def locate(self, source: str, dataset: str, expected: str) -> Place:
        """The folder that a source means: by name, or as a path.

        Args:
            source: `dataset:sequence`, or a path.
            dataset: name of the table.
            expected: hint of the error where a path leads nowhere.
        Raises:
            InputError: the sequence is unknown or not on disk, or there is no such folder.
        """
        table = load_table(dataset)
        parted = split_source(source)
        if parted is not None and parted[0] == dataset:
            row = self._row(dataset, parted[1])
            folder = self.root / row.folder
            if not folder.is_dir():
                get = (
                    f"download it: droidw data fetch {row.source}"
                    if row.archive
                    else f"get it by hand from {table.page}"
                )
                raise InputError(
                    f"{row.source} is not on disk: there is no folder {folder}",
                    f"{get}\nor name the folder that holds {row.folder}: --data DIR or "
                    f"{DATA_VARIABLE}=DIR",
                )
            return Place(folder, row.source.replace(":", "-"), row)
        folder = existing_folder(source, expected)
        name = folder.resolve().name
        known = [row for row in table.sequences.values() if Path(row.folder).name == name]
        return Place(folder, name or dataset, known[0] if known else None)

    def _row(self, dataset: str, name: str) -> KnownSequence:
        """A row of the table, or of a sequence that is on disk in the same way as those of it."""
        table = load_table(dataset)
        try:
            return table.sequence(name)
        except InputError:
            row = table.like_others(name)
            if not name or not (self.root / row.folder).is_dir():
                raise
            return row

    def camera(self, place: Place, size: tuple[int, int], problems: list[str]) -> Camera | None:
        """The camera of the table for pictures of this size, or None.

        Pictures that lie on their side get the camera turned likewise, reduced ones get it
        reduced; one of another shape gets none, with a sentence.
        """
        row = place.row
        if row is None or not row.camera.get("fx"):
            return None
        if row.published:
            said = "as published, which is wrong" if self.published else "not the published one"
            problems.append(f"camera: {row.source}: principal point {said}")
        wide, high = int(row.camera["width"]), int(row.camera["height"])
        if (size[0] > size[1]) != (wide > high) and wide != high:
            told = row.camera
            turned = {"width": high, "height": wide, "fx": told["fy"], "fy": told["fx"]}
            middle = {"cx": told["cy"], "cy": told["cx"]}
            row = replace(row, camera={**told, **turned, **middle}, published={})
            problems.append(f"camera: {row.source}: the calibration is turned with the pictures")
        camera = row.raw_camera(published=self.published)
        if camera is None or size == (camera.width, camera.height):
            return camera
        if abs(size[0] * camera.height / (size[1] * camera.width) - 1.0) > 0.005:
            problems.append(
                f"camera: the calibration of {row.source} is for {camera.width}x{camera.height} "
                f"px, another shape than the pictures of {size[0]}x{size[1]} px, and is not used"
            )
            return None
        return camera.resized(*size)


def existing_folder(source: str, expected: str) -> Path:
    """The folder `source`; `expected` is the hint of the error.

    Raises:
        InputError: it is not there or no folder.
    """
    path = Path(source)
    if not source:
        raise InputError("no folder was given", expected)
    if not path.exists():
        raise InputError(f"{source}: no such folder", expected)
    if not path.is_dir():
        raise InputError(f"{source} is not a folder", expected)
    return path
