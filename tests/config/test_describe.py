"""The generated files are up to date, and every key says what it means."""

from __future__ import annotations

import dataclasses
import enum
from pathlib import Path

import pytest

from droidw.config.describe import base_yaml, markdown, rows
from droidw.config.load import load_config
from droidw.config.schema import DroidwConfig

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("path", "text"), [("docs/configuration.md", markdown), ("configs/base.yaml", base_yaml)]
)
def test_generated_files_are_up_to_date(path, text):
    stored = (ROOT / path).read_text(encoding="utf-8")
    assert stored == text(), f"{path} is stale: python -m droidw.config.describe"


def test_base_yaml_holds_the_defaults():
    assert load_config([ROOT / "configs" / "base.yaml"]).data == dataclasses.asdict(DroidwConfig())


def test_every_key_is_explained():
    described = list(rows(DroidwConfig))
    assert [row.key for row in described if not row.help] == []
    assert len({row.key for row in described}) == len(described)


@dataclasses.dataclass(frozen=True)
class Odd:
    """Options of a plugin, of types that only a string stands for in YAML."""

    model: Path = Path("a/b.pt")
    choice: Choice = dataclasses.field(default_factory=lambda: Choice.FAST)


class Choice(enum.Enum):
    """A choice of a plugin."""

    FAST = 1


def test_options_of_other_types_are_described():
    assert [row.default for row in rows(Odd)] == ["a/b.pt", "FAST"]


def test_rows_say_type_default_and_limits():
    by_key = {row.key: row for row in rows(DroidwConfig)}
    fov = by_key["camera.fov"]
    assert (fov.type, fov.default, fov.limits) == ("number or null", "null", "> 1 and < 179")
    assert by_key["camera.size"].type == "list of whole numbers"
    assert by_key["weighting.gate"].type == "one of rational, inverse, none"
    assert by_key["schedule.init_blind.weigh"].default == "false"
