"""The same run twice, a run from its own configuration, and frame by frame from Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import droidw
from droidw.config.load import load_config
from droidw.config.resolve import resolve
from droidw.events import Dispatcher
from droidw.geometry.rectify import Rectifier
from droidw.geometry.se3 import inv, log, mul
from droidw.plugin.component import BuildContext
from droidw.slam.frame import RawFrame
from droidw.slam.optimise import Parts
from droidw.slam.system import SlamSystem

ALL_PARTS = ("features=cnn", "uncertainty=affine-softplus", "threads=2")


def test_one_seed_gives_the_same_bytes(go, footage):
    clip = footage()
    one, two = (go(clip.folder, *ALL_PARTS, "--seed", "5", to=name) for name in "ab")
    assert one.code == two.code == 0, one.err + two.err
    assert one.manifest["seed"] == 5
    for name in ("trajectory.tum", "keyframes.tum", "points.ply"):
        assert (one.folder / name).read_bytes() == (two.folder / name).read_bytes(), name


def test_the_configuration_of_a_run_runs_again(go, footage):
    clip = footage()
    one = go(clip.folder, "--seed", "3", "--stride", "2", *ALL_PARTS, to="a")
    assert one.code == 0, one.err
    two = go(None, "--config", one.folder / "config.yaml", to="b", quick=False)
    assert two.code == 0, two.err
    for name in ("trajectory.tum", "points.ply"):
        assert (one.folder / name).read_bytes() == (two.folder / name).read_bytes(), name
    settings = [load_config([ran.folder / "config.yaml"]).data for ran in (one, two)]
    assert settings[0] == settings[1]


def test_frames_that_do_not_fit_in_memory_are_read_again(go, footage):
    clip = footage()
    held = go(clip.folder, to="a")
    read = go(clip.folder, "filler.cache_mb=0", to="b")
    assert read.code == 0, read.err
    assert (held.folder / "trajectory.tum").read_bytes() == (
        read.folder / "trajectory.tum"
    ).read_bytes()


@pytest.fixture
def system(quick, rendered):
    """Build a system and the frames for it, from Python."""

    def make(threaded=False, more=()):
        plugins = droidw.load_plugins(environ={})
        config = load_config([], "cpu", [*quick[2:], *more])
        resolved = resolve(config, plugins)
        context = BuildContext(torch.device("cpu"), run_dir=Path("/nonexistent"))

        def part(slot):
            component, options = resolved.parts[slot]
            return component.factory(options, context)

        slots = ("features", "depth", "uncertainty", "ba", "correspondence")
        images, scene = rendered("handheld")
        rectify = Rectifier(scene.camera, long_side=160)
        frames = [rectify(RawFrame(k, k / 30, image, str(k))) for k, image in enumerate(images)]
        parts = Parts(**{slot: part(slot) for slot in slots})
        slam = SlamSystem(
            resolved.config, parts, rectify.camera, torch.device("cpu"), Dispatcher(),
            threaded=threaded,
        )  # fmt: skip
        return slam, frames

    return make


def test_frame_by_frame_equals_all_at_once(system):
    outcomes = []
    for mode in ("push", "track", "ahead"):
        slam, frames = system(threaded=mode == "ahead")
        if mode == "push":
            kept = [slam.push(frame) for frame in frames]
            assert kept[0] and 4 <= sum(kept) < len(frames)
        else:
            slam.track(iter(frames))
        assert slam.frames == len(frames) and slam.last_index == len(frames) - 1
        outcomes.append(slam.finish(lambda frames=frames: iter(frames)))
    first = outcomes[0]
    assert len(first.trajectory) == 26
    for other in outcomes[1:]:
        assert np.array_equal(first.trajectory.T_wc, other.trajectory.T_wc)
        assert np.array_equal(first.trajectory.times, other.trajectory.times)
        assert np.array_equal(first.cloud.xyz, other.cloud.xyz)
        assert [k.index for k in first.keyframes] == [k.index for k in other.keyframes]


LEARNED = ("features=cnn", "uncertainty=affine-softplus", "uncertainty.options.movable_gain=8")


@pytest.mark.parametrize("threaded", [False, True])
@pytest.mark.parametrize(("keep", "above"), [(0.9, 0.0), (0.0, 0.1), (0.9, 0.1), (0.0, 0.0)])
def test_what_can_move_is_asked_of_all_keyframes(system, keep, above, threaded):
    """Of all: the model may renew its start, motion is told without it, or all are learned anew.

    Of the first ones alone where nobody needs the others.
    """
    settings = (
        f"uncertainty.options.movable_keep={keep}",
        f"motion_filter.movable_above={above}",
        "frontend.starts=false",
    )
    slam, frames = system(threaded, (*LEARNED, *settings))
    features, model, op = slam.parts.features, slam.parts.uncertainty, slam.parts.correspondence
    asked, renewed, aside = [], [], []
    movable, renew, set_aside = features.movable, model.renew, op.aside
    features.movable = lambda *given: asked.append(movable(*given)) or asked[-1]
    model.renew = lambda view, k, found: renewed.append((k, found)) or renew(view, k, found)
    op.aside = lambda payload, cells: aside.append(cells) or set_aside(payload, cells)
    slam.track(iter(frames))
    count = len(slam.store)
    assert slam.frontend.initialised and count > 4
    assert len(aside) == (len(asked) if above else 0)
    assert len(asked) >= count
    for number, found in enumerate(slam.store["movable"]):
        assert any(torch.equal(found, one) for one in asked), number
    assert bool(renewed) is (keep > 0)
    for number, found in renewed:
        assert number >= 4 and any(found is one for one in asked)
    for cells, one in zip(aside, asked, strict=False):
        assert torch.equal(cells, one > above)

    asked.clear()
    slam, frames = system(threaded, (*LEARNED, *settings, "backend.learn=false"))
    movable = slam.parts.features.movable
    slam.parts.features.movable = lambda *given: asked.append(movable(*given)) or asked[-1]
    slam.track(iter(frames))
    if keep or above:
        assert len(asked) >= len(slam.store)
    elif not threaded:
        assert len(asked) == 4


def test_lines_hold_a_rendered_room(system, rendered):
    """The same whether frames are made ahead, and keyframes turned about as the camera was."""
    paths = {}
    for weight, threaded in ((30, False), (30, True), (0, False)):
        slam, frames = system(threaded, (f"lines.weight={weight}", "lines.least_share=0.2"))
        slam.track(iter(frames))
        outcome = slam.finish(lambda frames=frames: iter(frames))
        known = slam.store["axes_information"].flatten(1).any(dim=1)
        assert slam.optimiser.upright.holds is (weight > 0)
        assert (int(known.sum()) > len(known) / 2) is (weight > 0)
        assert all((info.lines is None) is (weight == 0) for info in slam.store.infos)
        paths[weight, threaded] = outcome.trajectory.T_wc
        true = [rendered("handheld")[1].T_wc(k.index) for k in outcome.keyframes]
        true = torch.from_numpy(np.stack(true))
        found = torch.from_numpy(np.stack([k.T_wc for k in outcome.keyframes]))
        apart = log(mul(mul(inv(found[:1]), found), inv(mul(inv(true[:1]), true))))
        # One picture of so small a room may be misled, for which lines do not count by default.
        assert float(torch.rad2deg(apart[:, 3:].norm(dim=1)).median()) < 0.5
    assert np.array_equal(paths[30, False], paths[30, True])
    assert not np.array_equal(paths[30, False], paths[0, False])


def test_the_mirrored_start_teaches_uncertainty_nothing(system, monkeypatch):
    """It is a trial: what is learned could not be taken back with it."""
    slam, frames = system(False, LEARNED)
    model, taught, tried = slam.parts.uncertainty, [], []
    update, trial = model.update, slam.frontend._try_mirrored
    monkeypatch.setattr(model, "update", lambda view: taught.append(0) or update(view))

    def counted():
        before = len(taught)
        trial()
        tried.append((before, len(taught)))

    monkeypatch.setattr(slam.frontend, "_try_mirrored", counted)
    slam.track(iter(frames))
    ((before, after),) = tried
    assert before > 0 and after == before
