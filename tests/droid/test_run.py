"""`droidw run` with the presets `paper` and `droid-slam`, and weights that were never trained.

Such weights track nothing; what is held is the mechanics: which updates happen, what is written,
that no value is NaN, and what is said where something is missing.
"""

from __future__ import annotations

import json
from collections import Counter

import cv2
import numpy as np
import pytest
import torch

from droidw.cli.main import main
from droidw.io.tum import read_tum
from droidw.testing.scenes import Scene, SceneSpec
from droidw_plugins._vit.published import FORMS, transformer_shapes
from droidw_plugins.correspondence import _droid_session
from droidw_plugins.depth._metric3d_net import published_shapes

# A network of the paper at a size that a test can pay for: small, and looking at small pictures.
SMALL_DEPTH = ["depth.options={variant: vit-small, size: [112, 140]}"]
QUICK = [
    "observers.report=null", "observers.progress=null", "threads=1", "motion_filter.force_every=3",
    "frontend.warmup=6", "frontend.max_factors=12", "backend.passes=[1,2]", "filler.updates=1",
    "schedule.init_blind.updates=1", "schedule.init.updates=1", "schedule.init_again.updates=1",
    "schedule.window.updates=1", "schedule.window_kept.updates=1",
]  # fmt: skip


def drawn(shapes):
    """Random tensors that keep signals at about their size."""
    g = torch.Generator().manual_seed(0)
    state = {}
    for key, shape in shapes.items():
        noise = torch.randn(shape, generator=g)
        if key.endswith(".gamma"):
            state[key] = 0.1 + 0.02 * noise
        elif len(shape) == 1:
            state[key] = 0.05 * noise + float(key.endswith(".weight"))
        else:
            state[key] = noise * (2.0 / np.prod(shape[1:])) ** 0.5
    return state


@pytest.fixture(scope="session")
def weights(tmp_path_factory, make_state):
    """A folder with files of the published form and names."""
    folder = tmp_path_factory.mktemp("weights")
    droid = {}
    for key, value in make_state().items():
        heads = key.startswith(("update.delta.2", "update.weight.2"))
        droid["module." + key] = torch.cat([value, value[:1]]) if heads else value
    torch.save(droid, folder / "droid.pth")
    torch.save(drawn(transformer_shapes(*FORMS["fit3d"])), folder / "fit3d.pth")
    torch.save(drawn(published_shapes("vit-small")), folder / "metric3d-vit-small.pth")
    return folder


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    """30 pictures of 160x128 with something that moves."""
    folder = tmp_path_factory.mktemp("clip") / "clip"
    Scene(SceneSpec(width=160, height=128, frames=30, motion="handheld")).write(folder)
    return folder


@pytest.fixture
def go(clip, tmp_path, monkeypatch, capsys):
    """Run the command: `go(weights folder, "--preset", "paper", ...)`; see `Ran`."""
    seen = []
    update = _droid_session.DroidSession.update

    def counted(self, request):
        answer = update(self, request)
        if self not in [session for session, _ in seen]:
            seen.append((self, []))
        values = [answer.target, answer.confidence]
        values += [] if answer.damping is None else [answer.damping]
        assert all(bool(torch.isfinite(v).all()) for v in values)
        next(log for session, log in seen if session is self).append(len(request.ids))
        return answer

    monkeypatch.setattr(_droid_session.DroidSession, "update", counted)

    def call(folder, *arguments):
        monkeypatch.setenv("DROIDW_WEIGHTS", str(folder))
        out = tmp_path / "out"
        code = main(["run", str(clip), "-o", str(out), *arguments])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        updates = {}
        for session, log in seen:
            updates.setdefault(session._purpose, []).append(len(log))
        return code, said.out, said.err, out, updates

    return call


def check_output(out, frames=30, full=False):
    """Shapes of what was written, and no value that is not finite; returns the manifest."""
    facts = json.loads((out / "manifest.json").read_text())
    trajectory = read_tum(out / "trajectory.tum")
    assert len(trajectory.times) == frames and np.isfinite(trajectory.T_wc).all()
    count = facts["keyframes"]
    numbers = np.load(out / "depth" / "depth.npz")
    assert numbers["depth"].shape == (count, 16, 20)
    assert all(np.isfinite(numbers[name]).all() for name in numbers.files)
    pictures = sorted((out / "depth").glob("*.png"))
    assert len(pictures) == count
    enlarged = sorted((out / "depth" / "full").glob("*.png"))
    assert len(enlarged) == (count if full else 0)
    for path in enlarged:
        assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape == (128, 160)
    log = (out / "log.txt").read_text().lower()
    assert "nan" not in log.split() and "not finite" not in log
    return facts


def test_preset_paper_runs_through(go, weights):
    code, _, wrong, out, updates = go(
        weights, "--preset", "paper", *SMALL_DEPTH, *QUICK, "exporters.depth.full=true"
    )
    assert code == 0, wrong
    facts = check_output(out, full=True)
    assert facts["preset"] == "paper" and facts["keyframes"] == 10
    # initialisation with 6 keyframes in 1 + 1 + 1 updates, then 1 + 1 for each of 4 more
    assert updates == {"window": [3 + 4 * 2], "global": [1, 2], "fill": [1, 1]}
    pictures = sorted((out / "uncertainty").glob("*.png"))
    shapes = Counter(cv2.imread(str(p), cv2.IMREAD_UNCHANGED).shape for p in pictures)
    assert shapes == {(16, 20): 10}


@pytest.mark.slow
@pytest.mark.parametrize("every", [9, 2])
def test_preset_paper_as_published(go, weights, every):
    """Nothing changed but the size of the depth network (and how often a keyframe is forced)."""
    code, _, wrong, out, updates = go(
        weights, "--preset", "paper", *SMALL_DEPTH, f"motion_filter.force_every={every}"
    )
    assert code == 0, wrong
    facts = check_output(out)
    count = -(-30 // every)
    assert facts["keyframes"] == count
    window = 24 + 5 * max(0, count - 12)
    batches = -(-(30 - count) // 16)
    assert updates == {"window": [window], "global": [7, 12], "fill": [12] * batches}


def test_preset_droid_slam_runs_through(go, weights):
    code, _, wrong, out, updates = go(
        weights, "--preset", "droid-slam", *QUICK, "--max-frames", "19"
    )
    assert code == 0, wrong
    facts = check_output(out, frames=19)
    assert facts["preset"] == "droid-slam" and not (out / "uncertainty").exists()
    # 7 keyframes; QUICK gives a third phase of initialisation one update
    assert updates == {"window": [3 + 2], "global": [1, 2], "fill": [1]}


def test_missing_weights_are_all_named(go, tmp_path):
    (tmp_path / "none").mkdir()
    code, _, wrong, out, _ = go(tmp_path / "none", "--preset", "paper")
    assert code == 5 and not out.exists()
    for name in ("droid", "fit3d", "metric3d-vit-large"):
        assert f"'{name}'" in wrong
    assert "droidw weights fetch" in wrong and "--preset auto" in wrong


def test_auto_falls_back_and_says_so(go, tmp_path):
    (tmp_path / "none").mkdir()
    code, _, wrong, out, _ = go(
        tmp_path / "none", "--preset", "auto", "--max-frames", "4",
        "observers.report=null", "observers.progress=null", "features=none", "uncertainty=none",
        "exporters={trajectory: {}}",
    )  # fmt: skip
    assert code == 0, wrong
    facts = json.loads((out / "manifest.json").read_text())
    assert facts["preset"] == "cpu"
    assert facts["note"].startswith("preset cpu, since paper lacks ")
    assert "correspondence 'droid' (weights missing: droid)" in facts["note"]
    assert facts["note"] in (out / "log.txt").read_text()


@pytest.mark.parametrize(("size", "said"), [
    ("[157,128]", "multiples of 8"), ("[160,56]", "too small for the DROID network"),
])  # fmt: skip
def test_pictures_that_the_network_cannot_take(go, weights, size, said):
    code, _, wrong, out, _ = go(weights, "--preset", "droid-slam", f"camera.size={size}")
    assert code == 3 and said in wrong and "camera.size" in wrong
    assert not out.exists()


def test_a_checkpoint_that_is_cut_short(go, weights, tmp_path):
    (tmp_path / "cut").mkdir()
    whole = (weights / "droid.pth").read_bytes()
    (tmp_path / "cut" / "droid.pth").write_bytes(whole[: len(whole) // 2])
    code, _, wrong, out, _ = go(tmp_path / "cut", "--preset", "droid-slam")
    assert code == 3 and "droid.pth cannot be read as weights" in wrong
    assert not out.exists()


def test_a_checkpoint_of_another_network(go, weights, tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "droid.pth").write_bytes((weights / "fit3d.pth").read_bytes())
    code, _, wrong, out, _ = go(tmp_path / "other", "--preset", "droid-slam")
    assert code == 3 and "these are not the weights of the DROID network" in wrong
    assert "102 of 102 tensors are missing" in wrong and not out.exists()
