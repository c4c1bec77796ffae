"""Pairs that global adjustment searches again, from about what it searched them from before."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from droidw.geometry.camera import Grid
from droidw_plugins.correspondence._flow_mask import bridge

H, W, MOVED = 160, 208, 5.3
BAND = np.s_[40:112]


def texture(seed, sigma):
    """A picture [H,2W] of waves so long."""
    rng = np.random.default_rng(seed)
    waves = cv2.GaussianBlur(rng.normal(size=(H, 2 * W)).astype(np.float32), (0, 0), sigma)
    return waves / waves.std()


@pytest.fixture
def pair(frame):
    """`pair(part, passing=None)`: two encoded pictures, the second moved by 5.3 pixels.

    In the middle rows something that is large and has more contrast moves by `passing` pixels.
    """
    still, band = texture(4, 2.0), texture(5, 6.0)
    y, x = np.mgrid[:H, :W].astype(np.float32)

    def moved(waves, by):
        return cv2.remap(waves, x + 60 - np.float32(by), y, cv2.INTER_LANCZOS4)

    def call(part, passing=None):
        grid = Grid.of(H, W, part.stride, part.offset)
        frames = []
        for k in range(2):
            picture = 128 + 12 * moved(still, k * MOVED)
            if passing is not None:
                picture[BAND] = (128 + 60 * moved(band, k * passing))[BAND]
            frames.append(part.encode(frame(k, np.clip(picture, 0, 255)), grid))
        return frames

    return call


def predicted(part, frames, off=0.0):
    """Targets both ways as they are, but for so many cells."""
    cells = (frames[0].centres - part.offset) / part.stride
    step = np.array([MOVED / part.stride + off, 0.0])
    return (cells + step).astype(np.float32), (cells - step).astype(np.float32)


def ask(part, frames, *, closed=0, off=0.0, fine=True, seeded=False):
    """Both edges where the first columns of cells are closed in both pictures."""
    gate = np.ones(frames[0].normal.shape[:2], np.float32)
    gate[:, :closed] = 0.0
    without = tuple(bridge(f, gate, 0.5, 7, part.options.blur) for f in frames)
    starts = predicted(part, frames, off)
    return part.both_ways(*frames, *starts, fine=fine, bridged=without, seeded=seeded)


@pytest.fixture
def engines(monkeypatch):
    """Kinds of all searches that are made of `part`: `engines(part)`."""

    def watch(part):
        kinds, engine = [], part._dense._engine

        def watched(kind, *rest):
            kinds.append(kind)
            return engine(kind, *rest)

        monkeypatch.setattr(part._dense, "_engine", watched)
        return kinds

    return watch


@pytest.mark.parametrize("change", [{"closed": 6}, {"off": 0.4}, {"closed": 6, "off": 0.4}])
def test_what_was_searched_hardly_moves(operator, pair, engines, change):
    part = operator(again_coarsest=0)
    frames, kinds = pair(part), engines(part)
    ask(part, frames, closed=4)
    assert set(kinds) == {"free"}
    kinds.clear()
    ask(part, frames, **change)
    assert kinds and set(kinds) == {"still"}


@pytest.mark.parametrize(
    ("options", "change", "kind"),
    [
        ({"again_coarsest": 8}, {"off": 0.4}, "free"),
        ({}, {"off": 1.5}, "free"),  # farther off than a patch reaches
        ({}, {"off": 0.4, "fine": False}, "started"),  # while tracking
        ({"warp": False}, {"off": 0.4}, "started"),
    ],
)
def test_else_it_may_have_moved(operator, pair, engines, options, change, kind):
    part = operator(**{"again_coarsest": 0, **options})
    frames = pair(part)
    ask(part, frames, closed=4, fine=change.get("fine", True))
    kinds = engines(part)
    ask(part, frames, closed=4, **change)
    assert set(kinds) == {kind}


def test_points_may_be_asked_of_what_hardly_moves(operator, pair, engines):
    part = operator(again_coarsest=0)
    frames = pair(part)
    ask(part, frames)
    kinds = engines(part)
    ask(part, frames, off=0.4, seeded=True)
    assert kinds[:2] == ["still", "still"]


def error(part, frames):
    """Pixels by which matches beside the band are off in a second search, mean of the farther half.

    Of rows of cells whose windows have nothing of the band.
    """
    ask(part, frames, off=0.4)
    edge, _ = ask(part, frames)
    off = part.stride * np.linalg.norm(edge.target - predicted(part, frames)[0], axis=-1)
    rows = [r for r, y in enumerate(frames[0].centres[:, 0, 1]) if 24 < y < 32 or 120 < y < 128]
    beside = off[rows, 3:-3].ravel()
    assert beside.size > 20
    return float(np.sort(beside)[beside.size // 2 :].mean())


def test_what_moves_does_not_lead_astray_what_is_beside_it(operator, pair):
    """On coarse levels a patch that is beside it on the finest one lies on it."""
    off = {}
    for coarsest in (0, 8):
        part = operator(again_coarsest=coarsest)
        off[coarsest] = error(part, pair(part, passing=-9.0))
    assert off[0] < 0.1
    assert off[0] < 0.8 * off[8]
