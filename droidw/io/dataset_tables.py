"""The datasets that droidw knows by name: `bonn:balloon`, where it lies, what took it.

One YAML per dataset in `configs/datasets`; its key `dataset` is the table read here.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from droidw.errors import InputError, did_you_mean
from droidw.plugin.cache import user_cache

if TYPE_CHECKING:
    from droidw.geometry.camera import Camera

__all__ = [
    "DATA_VARIABLE",
    "DatasetTable",
    "KnownSequence",
    "data_root",
    "load_table",
    "split_source",
    "table_names",
]

DATA_VARIABLE = "DROIDW_DATA"
"""Environment variable with the folder of datasets."""


@dataclass(frozen=True)
class KnownSequence:
    """One row of a table.

    Attributes:
        dataset, name: "bonn", "balloon".
        also: other names that are understood.
        folder: where it lies below the folder of datasets.
        archive: address of the download, "" where there is none.
        unpack: folder below that of datasets into which the archive is unpacked.
        below: only members of the archive whose path begins so.
        camera: width, height, fx, fy, cx, cy and dist of the raw pictures; may be empty.
        published: what of the camera the published system has otherwise (`compat: [droid-w]`).
        depth: path of its depth maps below the folder, and their scale; empty if it has none.
        ate: published error after Sim(3), or None; in `unit`.
        unit: unit of `ate`.
    """

    dataset: str
    name: str
    also: tuple[str, ...] = ()
    folder: str = ""
    archive: str = ""
    unpack: str = "."
    below: str = ""
    camera: Mapping[str, Any] = field(default_factory=dict)
    published: Mapping[str, Any] = field(default_factory=dict)
    depth: Mapping[str, Any] = field(default_factory=dict)
    ate: float | None = None
    unit: str = ""

    @property
    def source(self) -> str:
        """What to type: "bonn:balloon"."""
        return f"{self.dataset}:{self.name}"

    def raw_camera(self, *, published: bool = False) -> Camera | None:
        """The camera of the raw pictures, or None where the table has none.

        Args:
            published: with the slips of the published system.
        """
        if not self.camera:
            return None
        from droidw.geometry.camera import Camera

        facts = {**self.camera, **(self.published if published else {})}
        bent = tuple(float(value) for value in facts.pop("dist", ()))
        if any(bent):
            return Camera(**facts, distortion=bent, model="opencv")
        return Camera(**facts)


@dataclass(frozen=True)
class DatasetTable:
    """A dataset with its sequences.

    Attributes:
        name: as in `name:sequence`.
        title, page, reference, licence: for people.
        sequences: by name.
        told: the table as it stands in the file.
    """

    name: str
    title: str
    page: str
    reference: str
    licence: str
    sequences: Mapping[str, KnownSequence]
    told: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def like_others(self, name: str) -> KnownSequence:
        """A row for a sequence that the table has not, with what it says of all.

        It has a camera only where one camera took the whole dataset.
        """
        row = _sequence(self.name, name, self.told, {})
        return row if self.told.get("one_camera") else replace(row, camera={})

    def sequence(self, name: str) -> KnownSequence:
        """The sequence of that name, or of one that it also has.

        Raises:
            InputError: there is none; says the nearest and all.
        """
        for row in self.sequences.values():
            if name in (row.name, *row.also):
                return row
        names = [n for row in self.sequences.values() for n in (row.name, *row.also)]
        said = f"{self.title} has no sequence '{name}'" if name else f"{self.name}: which sequence?"
        raise InputError(
            said,
            did_you_mean(name, names, before=f"{self.name}:")
            + f"sequences: {', '.join(self.sequences)}",
        )


def table_names() -> list[str]:
    """Names of all datasets, sorted."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def load_table(name: str) -> DatasetTable:
    """The table of a dataset.

    Raises:
        InputError: there is none of that name; says the nearest and all.
    """
    names = table_names()
    if name not in names:
        raise InputError(
            f"no dataset is called '{name}'",
            did_you_mean(name, names) + f"datasets: {', '.join(names)}",
        )
    text = (_folder() / f"{name}.yaml").read_text(encoding="utf-8")
    told = yaml.safe_load(text)["dataset"]
    rows = told["sequences"]
    return DatasetTable(
        name=name,
        title=told["title"],
        page=told["page"],
        reference=told["reference"],
        licence=told["licence"],
        sequences={key: _sequence(name, key, told, row or {}) for key, row in rows.items()},
        told=told,
    )


def split_source(source: str) -> tuple[str, str] | None:
    """("bonn", "balloon") of "bonn:balloon"; None where it is a path or an address."""
    match = re.fullmatch(r"([a-z][a-z0-9-]+):([^\\]*)", source)
    if match is None or match[2].startswith("//") or Path(source).exists():
        return None
    return match[1], match[2].strip("/")


def data_root(environ: Mapping[str, str] = os.environ) -> Path:
    """The folder of datasets: `$DROIDW_DATA`, else in the cache of the user."""
    if environ.get(DATA_VARIABLE):
        return Path(environ[DATA_VARIABLE]).expanduser()
    return user_cache(environ) / "data"


def _sequence(
    dataset: str, name: str, told: Mapping[str, Any], row: Mapping[str, Any]
) -> KnownSequence:
    """A row, with what the table says of all; {name} and {camera} are filled in."""

    def text(key: str, otherwise: str = "") -> str:
        value = str(row.get(key, told.get(key, otherwise)))
        return value.replace("{name}", name).replace("{camera}", name.partition("_")[0])

    return KnownSequence(
        dataset=dataset,
        name=name,
        also=tuple(row.get("also", ())),
        folder=text("folder"),
        archive=text("archive"),
        unpack=text("unpack", "."),
        below=text("below"),
        camera={**told.get("camera", {}), **row.get("camera", {})},
        published=dict(row.get("published", {})),
        depth=dict(row.get("depth", told.get("depth", {}))),
        ate=row.get("ate"),
        unit=told.get("unit", ""),
    )


def _folder() -> Path:
    return Path(str(resources.files("droidw.configs"))) / "datasets"
