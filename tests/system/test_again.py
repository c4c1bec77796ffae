"""Footage is tracked a second time where that is doubtful, or what moves may be the world."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from droidw.run.again import Again
from droidw.run.drive import _Run
from droidw.slam.backend import Backend
from droidw.slam.filler import Filler
from droidw.slam.system import SlamSystem

LEARNED = (
    "features=cnn", "uncertainty=affine-softplus", "threads=1", "frontend.unknown_moves=1",
    # half of the time of a run: points, matched in doubt, and several starts
    "correspondence.options.seeds=0", "frontend.starts=false",
)  # fmt: skip
AGAIN = (*LEARNED, "frontend.again_below=1")


def closing(system, share=0.4):
    """Let uncertainty close a part of every keyframe, whatever it has learned."""
    columns = int(share * system.grid.width)

    def gates(nodes):
        found = torch.ones(len(nodes), system.grid.height, system.grid.width)
        found[..., :columns] = 0.0
        return found

    system.optimiser.learned_gates = gates


@pytest.fixture
def shut(monkeypatch):
    """Every system has something to hide once it is finished."""
    finish = SlamSystem.finish

    def finished(self, reread, *, brief=False):
        found = finish(self, reread, brief=brief)
        closing(self)
        return found

    monkeypatch.setattr(SlamSystem, "finish", finished)


@pytest.fixture
def watched(shut, monkeypatch):
    """Every system that a run finishes, and what is covered of its pictures in each stage."""
    made = []
    finish, adjust, fill = SlamSystem.finish, Backend.run, Filler.fill

    def covered(payloads):
        return [payload.covered for payload in payloads]

    def finished(self, reread, *, brief=False):
        seen = covered(info.payload for info in self.store.infos)
        made.append(SimpleNamespace(system=self, tracked=seen, filled=[]))
        return finish(self, reread, brief=brief)

    def adjusted(self, tell):
        made[-1].adjusted = covered(info.payload for info in made[-1].system.store.infos)
        made[-1].unmasked = made[-1].system.store["unmasked"].clone()
        adjust(self, tell)

    def filled(self, batch):
        made[-1].filled += covered(encoded.payload for encoded in batch)
        return fill(self, batch)

    monkeypatch.setattr(SlamSystem, "finish", finished)
    monkeypatch.setattr(Backend, "run", adjusted)
    monkeypatch.setattr(Filler, "fill", filled)
    return made


@pytest.mark.parametrize("cache", [512, 0])
def test_pictures_are_whole_again_once_all_is_tracked(go, footage, watched, cache):
    ran = go(footage().folder, *AGAIN, f"filler.cache_mb={cache}")
    assert ran.code == 0, ran.err
    assert ran.manifest["sweeps"] == ran.manifest["kept_sweep"] == 2
    assert 0 < ran.manifest["agreement"] <= 1
    one, two = watched
    assert all(mask is None for mask in one.tracked)
    assert any(mask is not None for mask in two.tracked)
    assert two.filled
    assert all(mask is None for mask in two.adjusted + two.filled)
    assert torch.equal(two.unmasked, torch.ones_like(two.unmasked))
    assert len(ran.poses) == 26


def test_nothing_is_kept_of_keyframes_that_are_dropped(go, footage, shut, monkeypatch):
    append, reveal, plain, kept = SlamSystem._append, SlamSystem._reveal, {}, []

    def added(self, current):
        if current.plain is not None:
            plain[current.frame.index] = weakref.ref(current.plain.context)
        return append(self, current)

    def revealed(self):
        # The motion filter goes on from the last candidate, dropped or not.
        held = {info.index for info in self.store.infos} | {self._filter._reference.frame.index}
        gc.collect()
        kept.append(({index for index, context in plain.items() if context() is not None}, held))
        reveal(self)

    monkeypatch.setattr(SlamSystem, "_append", added)
    monkeypatch.setattr(SlamSystem, "_reveal", revealed)
    often = "motion_filter.threshold=0.3", "frontend.keyframe_threshold=2.5"
    ran = go(footage().folder, *AGAIN, "filler.cache_mb=0", *often)
    assert ran.code == 0, ran.err
    alive, held = kept[1]
    assert alive and alive <= held
    assert set(plain) - held


def test_without_doubt_footage_is_tracked_once(go, footage, watched):
    ran = go(footage().folder, *LEARNED, "frontend.again_below=0")
    assert ran.code == 0, ran.err
    assert ran.manifest["sweeps"] == len(watched) == 1


def test_footage_is_tracked_without_what_may_move_alone(go, footage, watched):
    ran = go(footage().folder, "threads=1", "frontend.unknown_moves=0.3")
    assert ran.code == 0, ran.err
    assert ran.manifest["sweeps"] == len(watched) == 2
    one, two = watched
    assert all(mask is None for mask in one.tracked)
    for mask in two.tracked:
        assert mask[:, 80:].all()  # what was open: `closing` shuts the left
        assert not mask[:, :40].any()
    assert all(mask is None for mask in two.adjusted + two.filled)
    assert len(ran.poses) == 26


def test_a_still_room_of_which_much_is_closed_stays_the_world(go, footage):
    # The published step shuts half of it on these features, and then what is left the second time.
    learned = "features=cnn", "uncertainty=affine-softplus", "backend.backwards_below=1"
    ran = go(footage().folder, *learned, "threads=1")
    assert ran.code == 0, ran.err
    assert (ran.manifest["sweeps"], ran.manifest["kept_sweep"]) == (2, 1)
    assert "of what was seen while tracking agrees" in ran.warnings
    assert "could not be matched" not in ran.warnings


def test_what_does_not_hold_together_while_tracked_goes_no_further(
    go, footage, watched, monkeypatch
):
    real, asked = Again.unfounded, []

    def unfounded(self, second):
        asked.append(real(self, second))
        return "it is a house of cards"

    monkeypatch.setattr(Again, "unfounded", unfounded)
    ran = go(footage().folder, "threads=1", "frontend.unknown_moves=0.3")
    assert ran.code == 0, ran.err
    assert asked == [""]
    assert len(watched) == 1
    assert (ran.manifest["sweeps"], ran.manifest["kept_sweep"]) == (2, 1)
    assert "house of cards" in ran.warnings
    assert len(ran.poses) == 26


def test_twice_gives_the_same_bytes(go, footage, watched):
    one, two = (go(footage(name=name).folder, *AGAIN, to=f"to-{name}") for name in "ab")
    assert one.manifest["sweeps"] == two.manifest["sweeps"] == 2
    for name in ("trajectory.tum", "points.ply"):
        assert (one.folder / name).read_bytes() == (two.folder / name).read_bytes(), name


def test_a_users_mask_holds_in_both(go, footage, watched, tmp_path):
    clip = footage()
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = np.zeros((120, 160), np.uint8)
    mask[:, 120:] = 255
    for picture in sorted((clip.folder / "rgb").glob("*.png")):
        cv2.imwrite(str(masks / picture.name), mask)
    ran = go(clip.folder, *AGAIN, "--masks", masks)
    assert ran.code == 0, ran.err
    assert ran.manifest["sweeps"] == 2
    two = watched[1]
    assert two.tracked[0][:, 121:].all() and two.tracked[0][:, 10].any()
    for mask in two.adjusted:
        assert mask[:, 121:].all()
        assert not mask[:, :118].any()
    assert float(two.unmasked[..., 16:].max()) == 0.0


@pytest.mark.parametrize("error", [RuntimeError("no more"), KeyboardInterrupt()])
@pytest.mark.parametrize(
    ("owner", "stage"), [(_Run, "_build"), (SlamSystem, "track"), (SlamSystem, "finish")]
)
def test_what_was_found_first_stays_if_the_second_time_fails(
    go, footage, watched, monkeypatch, owner, stage, error
):
    plain = go(footage(name="a").folder, *LEARNED, "frontend.again_below=0", to="to-a")
    real, calls = getattr(owner, stage), []

    def second_time(self, *arguments, **options):
        calls.append(self)
        if len(calls) == 2:
            raise error
        return real(self, *arguments, **options)

    monkeypatch.setattr(owner, stage, second_time)
    ran = go(footage(name="b").folder, *AGAIN, to="to-b")
    assert ran.code == 0, ran.err
    assert (ran.manifest["sweeps"], ran.manifest["kept_sweep"]) == (2, 1)
    assert "what was found first is kept" in ran.warnings
    assert (str(error) or "KeyboardInterrupt") in ran.warnings
    assert (ran.folder / "trajectory.tum").read_bytes() == (
        plain.folder / "trajectory.tum"
    ).read_bytes()


def test_frames_that_cannot_be_read_again_are_not_lost(go, footage, shut, monkeypatch):
    clip, finish, calls = footage(), SlamSystem.finish, []

    def finished(self, reread, *, brief=False):
        found = finish(self, reread, brief=brief)
        if not calls:
            for picture in sorted((clip.folder / "rgb").glob("*.png"))[-8:]:
                picture.unlink()
        calls.append(self)
        return found

    monkeypatch.setattr(SlamSystem, "finish", finished)
    ran = go(clip.folder, *AGAIN)
    assert ran.code == 0, ran.err
    assert len(ran.poses) == 26
    assert ran.manifest["kept_sweep"] == 1
    assert "18 of 26 frames" in ran.warnings


def test_the_first_is_gone_while_the_second_tracks(go, footage, shut, monkeypatch):
    track, built, alive = SlamSystem.track, [], []

    def spy(self, frames):
        alive.append([one() is not None for one in built])
        built.append(weakref.ref(self))
        track(self, frames)

    monkeypatch.setattr(SlamSystem, "track", spy)
    ran = go(footage().folder, *AGAIN)
    assert ran.code == 0, ran.err
    assert alive == [[], [False]]


def test_an_outcome_that_agrees_much_less_is_left(go, footage, shut, monkeypatch):
    finish, calls = SlamSystem.finish, []

    def worse(self, reread, *, brief=False):
        found = finish(self, reread, brief=brief)
        calls.append(self)
        agreement = 0.6 if len(calls) == 1 else 0.3
        return replace(found, diagnosis=replace(found.diagnosis, agreement=agreement))

    monkeypatch.setattr(SlamSystem, "finish", worse)
    ran = go(footage().folder, *AGAIN)
    assert len(calls) == 2
    assert (ran.manifest["sweeps"], ran.manifest["kept_sweep"]) == (2, 1)
    assert "30 %" in ran.warnings
    assert ran.manifest["agreement"] == 0.6
