"""Which keyframes a frame between them is measured from."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from droidw.config.schema import DroidwConfig
from droidw.geometry.camera import Grid
from droidw.slam import filler as module
from droidw.slam.filler import Filler


@pytest.fixture
def sources(arc, waves, stored, monkeypatch):
    """`sources(*times, **options)`: keyframes that frames at these times are measured from.

    Six keyframes, a tenth of a second apart.
    """
    grid, intrinsics = Grid(6, 8, 8, 3.5), torch.tensor([60.0, 60.0, 31.5, 23.5])
    store = stored(grid, intrinsics, arc(6), waves(6, 6, 8))
    asked = []

    def locate(optimiser, payloads, start, sources, gates, **rest):
        asked.append(sources)
        return start

    monkeypatch.setattr(module, "locate", locate)

    def call(*times, keyframes=2, predict="velocity"):
        config = DroidwConfig()
        config.filler.keyframes, config.frontend.predict = keyframes, predict
        optimiser = SimpleNamespace(store=store, gates=lambda learned: None)
        frames = [SimpleNamespace(frame=SimpleNamespace(time=t), payload=None) for t in times]
        Filler(optimiser, config).fill(frames)
        return asked.pop()

    return call


def test_a_frame_is_measured_from_the_nearest_on_either_side(sources) -> None:
    assert sources(0.23) == [[1, 2, 3, 4]]
    assert sources(0.23, keyframes=1) == [[2, 3]]
    assert sources(0.23, keyframes=9) == [[0, 1, 2, 3, 4, 5]]


def test_near_either_end_there_are_fewer(sources) -> None:
    assert sources(0.04, 0.46) == [[0, 1, 2], [3, 4, 5]]


def test_behind_the_last_keyframe_those_before_it_take_part(sources) -> None:
    assert sources(0.57) == [[3, 4, 5]]
    assert sources(0.57, keyframes=1) == [[4, 5]]


def test_as_published_such_a_frame_is_measured_from_the_last_alone(sources) -> None:
    assert sources(0.57, keyframes=1, predict="hold") == [[5]]
