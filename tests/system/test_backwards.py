"""Runs whose keyframes are tracked from the last to the first as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from droidw.geometry.align import umeyama
from droidw.slam import backwards as module
from droidw.slam.backend import Backend

DOUBT = (
    "backend.backwards_below=1", "frontend.unknown_moves=1",
    "features=cnn", "uncertainty=affine-softplus", "threads=1",
    "correspondence.options.seeds=0",  # points, matched in doubt, are half of the time of a run
)  # fmt: skip
FILES = ("trajectory.tum", "keyframes.tum", "points.ply")


@pytest.fixture
def believed(monkeypatch):
    """Every way back agrees best."""
    real = module.track_backwards

    def tracked(*arguments):
        return replace(real(*arguments), agreement=1.0)

    monkeypatch.setattr(module, "track_backwards", tracked)


def test_a_run_may_have_the_way_back(go, footage, believed):
    ran = go(footage().folder, *DOUBT, "exporters.depth={}")
    assert ran.code == 0, ran.err
    assert ran.manifest["backwards"] == 1.0
    assert ran.manifest["agreement"] == 1.0
    assert ran.manifest["stages"]["backwards"] > 0
    assert len(ran.poses) == 26
    # The first camera is where the world begins, whichever way it was tracked.
    assert ran.poses[0, 1:] == pytest.approx([0, 0, 0, 0, 0, 0, 1], abs=1e-5)


def test_a_run_may_be_put_together_from_both_ways(go, footage, believed, monkeypatch):
    monkeypatch.setattr(module, "pieces", lambda ahead: [k < 3 for k in range(len(ahead))])
    # As good as it gets there and back: no gain is asked for.
    monkeypatch.setattr(module, "lead", lambda one, other: one)
    clip = footage()
    ran = go(clip.folder, *DOUBT)
    assert ran.code == 0, ran.err
    joints = ran.manifest["keyframes"] - 1
    assert ran.manifest["backwards"] == pytest.approx(1 - 3 / joints, abs=1e-4)
    # Joined in one scale and world: it goes where a plain run goes.
    plain = go(clip.folder, *DOUBT, "backend.backwards_below=0", to="to-plain")
    assert apart(plain, ran) < 0.1


def test_twice_gives_the_same_bytes(go, footage, believed):
    one, two = (go(footage(name=name).folder, *DOUBT, to=f"to-{name}") for name in "ab")
    assert one.manifest["backwards"] and two.manifest["backwards"]
    for name in FILES:
        assert (one.folder / name).read_bytes() == (two.folder / name).read_bytes(), name


def apart(one, other):
    """Greatest distance of two paths after Sim(3), as a share of what one extends over."""
    one, other = one.poses[:, 1:4], other.poses[:, 1:4]
    off = umeyama(other, one).apply(other) - one
    return np.linalg.norm(off, axis=1).max() / np.ptp(one, axis=0).max()


def test_the_way_there_is_kept_where_the_way_back_agrees_less(go, footage, monkeypatch):
    real = module.track_backwards
    monkeypatch.setattr(
        module, "track_backwards", lambda *arguments: replace(real(*arguments), agreement=0.0)
    )
    clip = footage()
    ran = go(clip.folder, *DOUBT, "backend.splice=false")
    assert ran.code == 0, ran.err
    assert ran.manifest["backwards"] == 0.0
    plain = go(clip.folder, *DOUBT, "backend.backwards_below=0", to="to-plain")
    # It has been measured once more, and learned from.
    assert apart(plain, ran) < 0.02


@pytest.mark.parametrize("how", ["fails", "is stopped"])
def test_the_way_there_is_what_it_would_have_been(go, footage, monkeypatch, how):
    plain = go(footage(name="a").folder, *DOUBT, "backend.backwards_below=0", to="to-a")
    assert plain.manifest["backwards"] == 0.0
    assert "backwards" not in plain.manifest["stages"]
    run, real, calls = Backend.run, module.track_backwards, []

    def second(self, tell):
        calls.append(self)
        if len(calls) == 2:
            raise RuntimeError("no more")
        return run(self, tell)

    def tracked(optimiser, config, tell, stopped):
        return real(optimiser, config, tell, lambda: True)

    if how == "fails":
        monkeypatch.setattr(Backend, "run", second)
    else:
        monkeypatch.setattr(module, "track_backwards", tracked)
    ran = go(footage(name="b").folder, *DOUBT, "backend.splice=false", to="to-b")
    assert ran.code == 0, ran.err
    assert ran.manifest["backwards"] == 0.0
    assert ("no more" in ran.warnings) == (how == "fails")
    for name in FILES:
        assert (ran.folder / name).read_bytes() == (plain.folder / name).read_bytes(), name
